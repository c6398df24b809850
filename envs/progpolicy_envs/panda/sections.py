"""What the docstrings of the four Panda environments have in common; see :mod:`progpolicy_envs.documentation`."""

SECTIONS = {
    "colours": """
        Everything that has a colour is worked on in colour order: red, blue, green, yellow, violet, orange, cyan, pink.
        """,
    "spaces": """
        ## Action Space
        ``Box(-1, 1, (4,))``, applied for 1/30 s. The gripper points down and its fingers open along y.

        | Num | Action | Meaning                                                                        |
        |-----|--------|--------------------------------------------------------------------------------|
        | 0-2 | move   | displacement of the gripper along x, y and z; 1 is 5 cm (an arm of finite      |
        |     |        | strength covers a little more than half of it in the step)                     |
        | 3   | open   | change of the finger width; 1 is 20 cm, so that the sign opens or closes       |

        ## Observation Space
        ``Box(-10, 10, (32,))`` in metres and seconds: the robot and ONE object with its target, the first unfinished
        one in colour order, so that the numbers mean the same with any number of objects. Finishing an object moves the
        focus on; disturbing a finished one brings it back. With ``observation="goal"`` the same numbers come as a
        dictionary: ``observation`` (0-25), ``achieved_goal`` (26-28) and ``desired_goal`` (29-31).

        | Num   | Observation  | Meaning                                                                           |
        |-------|--------------|-----------------------------------------------------------------------------------|
        | 0-2   | gripper      | position of the gripper; the robot stands at (-0.6, 0, 0), the table's top is z = 0 |
        | 3-5   | gripper_v    | its velocity                                                                      |
        | 6     | fingers      | distance between the fingers, 0 to 0.08                                           |
        | 7-9   | object_d     | object minus gripper                                                              |
        | 10-12 | target_d     | target minus gripper                                                              |
        | 13    | distance     | horizontal distance from object to target                                         |
        | 14-15 | line         | unit vector from object to target in the plane                                    |
        | 16    | along        | gripper relative to the object along that line; negative is behind the object     |
        | 17    | across       | gripper relative to the object across that line, left of it positive              |
        | 18-20 | object_v     | velocity of the object                                                            |
        | 21-22 | turn         | cosine and sine of four times the object's yaw: a cube looks the same four times  |
        | 23    | spin         | angular velocity about z                                                          |
        | 24    | reach        | horizontal distance from gripper to object                                        |
        | 25    | left         | unfinished objects divided by 8                                                   |
        | 26-28 | object       | position of the object                                                            |
        | 29-31 | target       | position of its target                                                            |
        """,
    "rewards": """
        * 1 for every object that becomes finished, -1 for every one that ceases to be,
        * -0.01 for the step,
        * -5 when an object leaves the table.

        Progress is measured as a difference, so that nothing is gained by moving to and fro.
        """,
    "gains": """
        -0.01 for the step, -5 for a failure, and what is gained in a potential, so that no way back and forth pays: an
        episode pays the difference between its last and its first state. ``env.unwrapped.potential()`` returns it, the
        sum of
        """,
    "left": """
        * -10 per metre from every object to its target, finished or not: to move any of them away costs at once,
        """,
    "leaving": """
        * where that way is longer than 5 to 15 cm and the gripper is near a finished block, nearer than 6 to 12 cm and
          less than 2 to 6 cm above it, the way counts 0.6 m instead, as far as both are so: leaving is paid first,
        * 0.6 m of way more for every other block that is left, so that to finish one costs nothing,
        * 1 for every finished block.
        """,
    "reach": """
        With it, an unfinished block nearer than 20 cm to the axis on which the arm turns, or farther than 80 cm, ends
        the episode as a failure.
        """,
    "start": """
        ``env.reset(options={"n_objects": 1, "starts": [[-0.1, 0.1]], "targets": [[0.0, -0.1]]})`` gives them instead,
        as x and y in metres; whether the task can then be solved is not checked. Starts
        of what ``n_done`` has finished are not used. ``env.unwrapped.start`` is what the
        present episode started with, in this form.
        """,
    "rules": """
        ## Information
        ``info["is_success"]`` at every step; at reset also ``info["variation"]``. Steps also carry ``is_failure`` and
        what ``compute_reward`` of the goal form needs besides the goals: ``settled``, ``previous_achieved_goal``,
        ``shaping``. ``env.unwrapped.plan()`` iterates over the actions of a scripted controller.

        ## Arguments
        ``gym.make("$id", $size=5)`` or ``env.reset(options={"$size": 5})``; an option stays in force until it is
        changed. Values that are not accepted raise ``ValueError``.
        ``context="observed"``, for ``gym.make``, adds the variation's numbers, from 0 to 1, to the end of observations.

        | Parameter   | Values              | Default   | Meaning                                                   |
        |-------------|---------------------|-----------|-----------------------------------------------------------|
        | $size   | 1 to 8              | 1         | number of $things                                         |
        | n_done      | 0 to 7, "random"    | 0         | $things finished at the start, fewer than there are;      |
        |             |                     |           | "random" draws a number for every episode                 |
        | observation | "flat", "goal"      | "flat"    | one array, or the dictionary of a goal environment        |
        | reward_type | "dense", "sparse",  | "dense"   | see above                                                 |
        |             | "potential"         |           |                                                           |
        | physics     | ``Physics``, None   | None      | time step and solver; None is 120 Hz, 4 steps an action   |

        ## References
        panda-gym (Gallouédec, Cazin, Dellandréa and Chen, 2021), whose robot, table and control these are.
        Ng, Harada and Russell, Policy invariance under reward transformations, ICML 1999: rewards by potential, here
        without discount.

        ## Version History
        * v0: initial version; ``reward_type="potential"`` came later and changes nothing of the others
        """,
}
