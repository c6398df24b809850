"""Hiking by the right-hand rule: once for any map, from the window around the hiker, and once for one known map."""

import numpy as np

from progpolicy_envs.hiking import HikingEgoEnv, HikingEnv
from progpolicy_envs.layouts import LAYOUTS, NEIGHBOURS, Layout
from sb3_progpolicy.programs.syntax import Program
from tests.handwritten.build import Builder

ACTION_NAMES = HikingEnv.action_names
AHEAD = {"north": "window[-1,+0]", "east": "window[+0,+1]", "south": "window[+1,+0]", "west": "window[+0,-1]"}
#: Preference for a turn, counted clockwise from straight on: straight on, right, back, left.
PREFERENCE = (2.0, 3.0, 0.0, 1.0)
OPEN = 3.5  # more than the largest preference, so that no blocked cell is chosen


def egocentric_program() -> Program:
    """Return one affine controller: the right-hand rule, a star next to the hiker first."""
    builder = Builder(HikingEgoEnv())
    scores: dict[str, dict[str, float]] = {}
    for direction, name in enumerate(ACTION_NAMES):
        scores[name] = {AHEAD[name]: OPEN}
        for previous, previous_name in enumerate(ACTION_NAMES):
            scores[name][f"previous {previous_name}"] = PREFERENCE[(direction - previous) % 4]
    return builder.program(builder.controller(scores), env="HikingEgo-v0")


def right_hand_turn(layout: Layout, cell: int, heading: int) -> int:
    """Return where the right-hand rule goes from a cell entered with a heading."""
    ways = [way for way in range(4) if NEIGHBOURS[cell, way] != cell and layout.is_path[NEIGHBOURS[cell, way]]]
    return max(ways, key=lambda way: PREFERENCE[(way - heading) % 4])


def turns(layout: Layout, heading: int) -> dict[int, int]:
    """Return, for the cells that can be entered with a heading and where the rule does not go straight on, its way."""
    cells = [
        int(cell)
        for cell in np.flatnonzero(layout.is_path)
        if cell == layout.start
        or (NEIGHBOURS[cell, heading - 2] != cell and layout.is_path[NEIGHBOURS[cell, heading - 2]])
    ]
    ways = {cell: right_hand_turn(layout, cell, heading) for cell in cells}
    return {cell: way for cell, way in ways.items() if way != heading}


def map_program(layout: str = "valley", env_id: str = "Hiking-v1") -> Program:
    """Return the right-hand rule of one map as a table: a branch for each previous action.

    In the branch of a heading, straight on has the constant 1 and the hiker on a turning cell adds 2 to its way.
    In Hiking-v1 all stars on other turning cells of the branch add at most a half to the ways of these, which does no
    harm. In Hiking-v0 each adds an eighth, which does none while fewer than eight of them agree.
    """
    builder = Builder(HikingEnv())
    controllers = []
    for heading, name in enumerate(ACTION_NAMES):
        scores: dict[str, dict[str, float]] = {way: {} for way in ACTION_NAMES}
        for cell, way in turns(LAYOUTS[layout], heading).items():
            scores[ACTION_NAMES[way]][f"map[{cell // 10},{cell % 10}]"] = 2.0
        controllers.append(builder.controller(scores, bias={name: 1.0}))
    came_from = [builder.affine({f"previous {name}": 1.0}, -0.5) for name in ACTION_NAMES[:-1]]
    body = builder.chain(list(zip(came_from, controllers[:-1], strict=True)), controllers[-1])
    return builder.program(body, env=env_id, layout=layout)
