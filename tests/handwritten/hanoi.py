"""Hanoi by one affine controller: optimal for any number of discs and any pair of pegs."""

import progpolicy_envs.hanoi as domain
from sb3_progpolicy.programs.syntax import Program
from tests.handwritten.build import Builder

NOT_THE_SAME_DISC, SMALLER_ONTO_LARGER, ONTO_THE_OTHER_COLOUR = -10.0, 1.0, 0.8


def hanoi_program() -> Program:
    """Return the program.

    A move has the greater score the more the disc under it is larger than the moved one, which rules out illegal
    moves and prefers the smallest disc; among the two places of the smallest disc the colour decides (the smallest
    is -1, so +1 is the other colour). What the last move put down is not picked up again, so that every second move
    is the one legal move without the smallest disc. The bit that the observation lacks, which disc was moved last,
    is thus read off the previous action.
    """
    builder = Builder(domain.HanoiEnv())
    scores: dict[str, dict[str, float]] = {}
    for move, (source, target) in zip(domain.ACTION_NAMES, domain.MOVES, strict=True):
        scores[move] = {
            f"rank[{source}]": -SMALLER_ONTO_LARGER,
            f"rank[{target}]": SMALLER_ONTO_LARGER,
            f"colour[{target}]": ONTO_THE_OTHER_COLOUR,
        }
        for previous, (_, put_down) in zip(domain.ACTION_NAMES, domain.MOVES, strict=True):
            if put_down == source:
                scores[move][f"previous {previous}"] = NOT_THE_SAME_DISC
    return builder.program(builder.controller(scores), env="Hanoi-v0")
