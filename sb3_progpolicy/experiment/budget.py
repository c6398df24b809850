"""A limit on the processor time of a training, so that methods can be compared at equal cost."""

from __future__ import annotations

import time

from stable_baselines3.common.callbacks import BaseCallback


class ProcessorTimeLimit(BaseCallback):
    """Ends training when this process has used a number of seconds of processor time, all threads together.

    :param seconds: the limit, above 0
    :param used: seconds that a run which goes on now had used before
    :raises ValueError: if the limit is not above 0
    """

    def __init__(self, seconds: float, used: float = 0.0) -> None:
        super().__init__()
        if not seconds > 0:
            raise ValueError(f"seconds={seconds} is not accepted; it is above 0")
        self.seconds, self.used_before = seconds, used
        self._started = time.process_time()
        #: Whether the limit has ended the training.
        self.reached = False

    @property
    def used(self) -> float:
        """Seconds used up to now, those before included."""
        return self.used_before + time.process_time() - self._started

    def _on_training_start(self) -> None:
        self._started = time.process_time()

    def _on_step(self) -> bool:
        self.reached = self.reached or self.used >= self.seconds
        return not self.reached
