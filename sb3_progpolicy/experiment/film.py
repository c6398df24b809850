"""Films of episodes: a program, a planner or random actions in an environment, as an animated GIF or an MP4."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from sb3_progpolicy.experiment.sources import Source, find_source
from sb3_progpolicy.nearest import unknown
from sb3_progpolicy.programs.files import write_atomically

LAST_FRAME_SECONDS = 2.0
ACTORS = ("policy", "planner", "random")


def record(
    source: Source,
    output: Path,
    variation: Mapping[str, Any],
    actor: str = "policy",
    semantics: str = "crisp",
    seed: int = 0,
    fps: int | None = None,
    max_steps: int | None = None,
) -> tuple[int, bool | None]:
    """Play an episode and write it as a film.

    :param source: the program, and its environment
    :param output: file to write, ``.gif`` or ``.mp4``
    :param variation: to play
    :param actor: who acts: ``"policy"``, ``"planner"`` or ``"random"``
    :param semantics: ``"crisp"`` or ``"soft"``
    :param seed: of the environment
    :param fps: frames per second; the environment's by default
    :param max_steps: cap of the episode; the registered one by default
    :return: steps, and whether the goal was reached; ``None`` where the environment reports none
    :raises ValueError: if the source has no environment or no program, the environment does not read what the variation
        says, or the file's name ends otherwise
    """
    import gymnasium as gym

    from sb3_progpolicy.env_ids import spec_of
    from sb3_progpolicy.reptile.options import ReadOptions, refuse_unread, split_variation

    if output.suffix.lower() not in FORMATS:
        raise ValueError(f"-o {str(output)!r} is not accepted; the file is a .gif or an .mp4")
    if actor not in ACTORS:
        raise unknown("actor", actor, ACTORS)
    source = source.within()
    assert source.env_id is not None
    _check_renders(source.env_id)
    cap = max_steps or source.env_kwargs.get("max_episode_steps") or spec_of(source.env_id).max_episode_steps
    if cap is None:
        raise ValueError(f"{source.env_id} has no cap on steps; give --max-steps")
    kwargs = {name: value for name, value in source.env_kwargs.items() if name != "max_episode_steps"}
    fixed, given = split_variation(source.env_id, variation, kwargs)
    env = gym.make(source.env_id, render_mode="rgb_array", max_episode_steps=cap, **{**kwargs, **fixed})
    try:
        options = ReadOptions(given)
        observation, info = env.reset(seed=seed, options=options)
        refuse_unread([options], source.env_id)
        env.action_space.seed(seed)
        if actor == "policy":
            act = _policy(source, semantics, env)
        else:
            act = _planner(env) if actor == "planner" else _random(env)
        with FORMATS[output.suffix.lower()](fps or env.metadata.get("render_fps", 4)) as frames:
            steps, success = _play(env, act, observation, info.get("optimal_steps"), cap, frames.add)
            write_atomically(output, frames.content())
    finally:
        env.close()
    return steps, success


def _check_renders(env_id: str) -> None:
    """Raise ``ValueError`` if an environment has no pictures."""
    from sb3_progpolicy.env_ids import creator_of

    metadata = getattr(creator_of(env_id), "metadata", None)
    if metadata is not None and "rgb_array" not in metadata.get("render_modes", ()):
        modes = ", ".join(map(str, metadata.get("render_modes", ()))) or "none"
        raise ValueError(f"{env_id} cannot be filmed; a film needs the render mode rgb_array, and it has {modes}")


def _picture(env: Any) -> Any:
    """Return what an environment shows, ``(height, width, 3)`` bytes."""
    import numpy as np

    frame = env.render()
    if not isinstance(frame, np.ndarray) or frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
        what = f"{frame.dtype} {frame.shape}" if isinstance(frame, np.ndarray) else type(frame).__name__
        raise ValueError(
            f"{env.spec.id} cannot be filmed; its render() returned {what} where (height, width, 3) bytes are expected"
        )
    return frame


def environment_of(name: str) -> Source:
    """Return a source for an environment alone; a run or program stands for its environment, as an id does.

    :param name: an id, or what :func:`~sb3_progpolicy.experiment.sources.find_source` takes
    """
    import gymnasium as gym

    from sb3_progpolicy.env_ids import spec_of

    if name in gym.registry or not Path(name).exists():
        return Source(name, spec_of(name).id, None, None, {})
    return find_source(name)


Act = Callable[[Any, float, bool], Any]


def _policy(source: Source, semantics: Any, env: Any) -> Act:
    if source.program is None:
        raise ValueError(f"{source.name} is not a program; render plays programs, planners and random actions")
    from sb3_progpolicy.programs.interpreter import ProgramRunner, join_inputs
    from sb3_progpolicy.spaces import shaped
    from sb3_progpolicy.surroundings import refuse_wrappers

    refuse_wrappers("the program", source.program.metadata.get("wrappers", ()))
    program, previous = source.program, None
    runner = ProgramRunner(program, 1, semantics)

    def act(observation: Any, reward: float, done: bool) -> Any:
        nonlocal previous
        previous = runner.act(join_inputs(program, observation, previous, reward, done))
        return shaped(previous, env.action_space)[0]

    return act


def _random(env: Any) -> Act:
    return lambda observation, reward, done: env.action_space.sample()


def _planner(env: Any) -> Act:
    """The actions of the environment's own planner."""
    from progpolicy_envs import DOMAINS

    if not hasattr(env.unwrapped, "plan"):
        raise ValueError(f"--planner is not accepted for {env.spec.id}; it is for {', '.join(DOMAINS)}")
    planned = iter(env.unwrapped.plan())
    return lambda observation, reward, done: next(planned, None)


def _play(
    env: Any, act: Act, observation: Any, optimal: int | None, cap: int, show: Callable[[Any], None]
) -> tuple[int, bool | None]:
    from rich.console import Console
    from rich.progress import Progress

    reward, done, info, steps = 0.0, False, dict[str, Any](), 0
    show(_picture(env))
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("playing", total=optimal or cap)
        while not done:
            action = act(observation, reward, done)
            if action is None:  # the plan has come to its end
                break
            observation, reward, terminated, truncated, info = env.step(action)
            done = terminated or truncated
            steps += 1
            show(_picture(env))
            progress.advance(task)
    return steps, bool(info["is_success"]) if "is_success" in info else None


class _Gif:
    """Pictures in one palette, so that colours do not flicker and unchanged pixels cost nothing.

    :param fps: frames per second
    """

    def __init__(self, fps: int) -> None:
        try:
            from PIL import Image
        except ImportError:
            raise ValueError('render needs Pillow for a .gif: pip install "sb3-progpolicy[render]"') from None
        self._image, self._fps = Image, fps
        self._frames: list[Any] = []

    def __enter__(self) -> _Gif:
        return self

    def __exit__(self, *_: object) -> None:
        self._frames.clear()

    def add(self, frame: Any) -> None:
        """Add a picture, ``(height, width, 3)`` bytes; the first one gives the palette."""
        image = self._image.fromarray(frame)
        if self._frames:
            self._frames.append(image.quantize(palette=self._frames[0], dither=self._image.Dither.NONE))
        else:
            # The default method gives a small thing, such as a plate, the colour of a larger one that looks like it.
            self._frames.append(image.quantize(256, self._image.Quantize.MAXCOVERAGE))

    def content(self) -> bytes:
        """Return the file's content."""
        durations = [1000 // self._fps] * (len(self._frames) - 1) + [int(1000 * LAST_FRAME_SECONDS)]
        buffer = io.BytesIO()
        first, *others = self._frames
        first.save(buffer, format="GIF", save_all=True, append_images=others, duration=durations, loop=0)
        return buffer.getvalue()


class _Mp4:
    """A film, encoded while it is made; ffmpeg comes with the package ``imageio-ffmpeg``.

    :param fps: frames per second
    """

    def __init__(self, fps: int) -> None:
        try:
            import imageio_ffmpeg
        except ImportError:
            raise ValueError('render needs imageio-ffmpeg for an .mp4: pip install "sb3-progpolicy[video]"') from None
        self._ffmpeg, self._fps = imageio_ffmpeg, fps
        self._folder = tempfile.TemporaryDirectory()
        self._path = Path(self._folder.name, "film.mp4")
        self._encoder: Any = None
        self._last: Any = None

    def __enter__(self) -> _Mp4:
        return self

    def __exit__(self, *_: object) -> None:
        if self._encoder is not None:
            self._encoder.close()
        self._folder.cleanup()

    def add(self, frame: Any) -> None:
        """Add a picture, ``(height, width, 3)`` bytes."""
        if self._encoder is None:
            size = frame.shape[1::-1]
            self._encoder = self._ffmpeg.write_frames(str(self._path), size, fps=self._fps, macro_block_size=2)
            self._encoder.send(None)
        self._last = frame
        self._encoder.send(frame.tobytes())

    def content(self) -> bytes:
        """Return the file's content."""
        for _ in range(int(self._fps * LAST_FRAME_SECONDS)):
            self._encoder.send(self._last.tobytes())
        self._encoder.close()
        return self._path.read_bytes()


FORMATS: dict[str, type[_Gif] | type[_Mp4]] = {".gif": _Gif, ".mp4": _Mp4}
