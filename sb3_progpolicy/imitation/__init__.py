"""From a teacher to a program: a planner, a trained model or any function from observations to actions is imitated."""

from sb3_progpolicy.imitation.algorithm import imitate
from sb3_progpolicy.imitation.comparison import Comparison, compare_with_teacher
from sb3_progpolicy.imitation.rounds import Imitation
from sb3_progpolicy.imitation.teachers import Teacher, make_teacher

__all__ = ["Comparison", "Imitation", "Teacher", "compare_with_teacher", "imitate", "make_teacher"]
