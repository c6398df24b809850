"""Print how the hand-written programs do on training and unseen variations: ``python -m tests.handwritten``."""

from progpolicy_envs import DOMAINS, HIKING_EGOCENTRIC
from tests.handwritten.evaluate import play_batch, size_of
from tests.handwritten.hanoi import hanoi_program
from tests.handwritten.hiking import egocentric_program, map_program
from tests.handwritten.stacking import stacking_program

PROGRAMS = (
    (DOMAINS["Hanoi-v0"], hanoi_program()),
    (DOMAINS["Hiking-v0"], map_program()),
    (HIKING_EGOCENTRIC, egocentric_program()),
    (DOMAINS["Stacking-v0"], stacking_program()),
)
N_SEEDS = 100

if __name__ == "__main__":
    print(f"seeds 0 to {N_SEEDS - 1} of every variation; ratio = all steps / all of the planner's steps\n")
    header = f"{'domain':<26}{'branches':>9}{'set':>8}{'success':>9}{'steps':>8}{'planner':>9}{'ratio':>7}"
    print(header)
    for domain, program in PROGRAMS:
        name = " ".join([domain.id, *domain.arguments.values()])
        for part, variations in (("train", domain.train), ("unseen", domain.unseen)):
            episodes = [
                episode
                for variation in variations
                for episode in play_batch(program, domain.id, N_SEEDS, **domain.arguments, **variation)
            ]
            success = sum(episode.success for episode in episodes) / len(episodes)
            steps, optimal = (sum(getattr(e, what) for e in episodes) / len(episodes) for what in ("steps", "optimal"))
            print(
                f"{name:<26}{size_of(program)[1]:>9}{part:>8}{success:>9.1%}{steps:>8.2f}{optimal:>9.2f}"
                f"{steps / optimal:>7.3f}"
            )
