"""``progpolicy render``: an episode as an animated GIF or an MP4 film."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from sb3_progpolicy.cli.parsing import ALLOW_PICKLE, check_folder, default_variations, parse_variations
from sb3_progpolicy.cli.streams import quiet_stdout
from sb3_progpolicy.experiment.sources import Source, find_source
from sb3_progpolicy.nearest import unknown
from sb3_progpolicy.programs.files import write_atomically

LAST_FRAME_SECONDS = 2.0


def render(
    run_or_name: Annotated[
        str,
        typer.Argument(help="run folder, program, model or pretrained name; with --planner or --random also an id"),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="file to write, .gif or .mp4")],
    variation: Annotated[list[str] | None, typer.Option("--set", help="the variation: n_discs=7")] = None,
    planner: Annotated[bool, typer.Option("--planner", help="the domain's planner acts")] = False,
    random: Annotated[bool, typer.Option("--random", help="actions are drawn at random")] = False,
    semantics: Annotated[str, typer.Option("--semantics", help="crisp or soft")] = "crisp",
    seed: Annotated[int, typer.Option("--seed", min=0, help="of the environment")] = 0,
    fps: Annotated[int | None, typer.Option("--fps", min=1, max=50, help="frames per second")] = None,
    max_steps: Annotated[int | None, typer.Option("--max-steps", min=1, help="cap of the episode")] = None,
    allow_pickle: Annotated[bool, typer.Option("--allow-pickle", help=ALLOW_PICKLE)] = False,
) -> None:
    """Play one episode and write it as an animated GIF or an MP4 film."""
    if output.suffix.lower() not in _FORMATS:
        raise ValueError(f"-o {str(output)!r} is not accepted; the file is a .gif or an .mp4")
    check_folder(output)
    if planner and random:
        raise ValueError("--planner and --random are not accepted together")
    if semantics not in ("crisp", "soft"):
        raise unknown("semantics", semantics, ("crisp", "soft"))
    with quiet_stdout():
        source = _environment_of(run_or_name) if planner or random else find_source(run_or_name, allow_pickle)
        steps, success = _render(source, output, variation, planner, random, semantics, seed, fps, max_steps)
    typer.echo(f"Wrote {output}: {steps} steps, {'goal reached' if success else 'goal not reached'}", err=True)


def _render(
    source: Source,
    output: Path,
    pairs: list[str] | None,
    planner: bool,
    random: bool,
    semantics: str,
    seed: int,
    fps: int | None,
    max_steps: int | None,
) -> tuple[int, bool]:
    import gymnasium as gym

    from sb3_progpolicy.evaluation import spec_of

    if source.env_id is None:
        raise ValueError(f"{source.name} does not say which environment it is for")
    variations = parse_variations(pairs) if pairs else default_variations(source.env_id)[-1:]
    if len(variations) != 1:
        raise ValueError(f"--set gives {len(variations)} variations; one episode has one")
    cap = max_steps or spec_of(source.env_id).max_episode_steps
    if cap is None:
        raise ValueError(f"{source.env_id} has no cap on steps; give --max-steps")
    env = gym.make(source.env_id, render_mode="rgb_array", max_episode_steps=cap, **source.env_kwargs)
    try:
        observation, info = env.reset(seed=seed, options=variations[0])
        env.action_space.seed(seed)
        act = _planner(env) if planner else _random(env) if random else _policy(source, semantics)
        with _FORMATS[output.suffix.lower()](fps or env.metadata.get("render_fps", 4)) as frames:
            steps, success = _play(env, act, observation, info.get("optimal_steps"), cap, frames.add)
            write_atomically(output, frames.content())
    finally:
        env.close()
    return steps, success


def _environment_of(name: str) -> Source:
    """A run or program stands for its environment here, as an id does."""
    import gymnasium as gym

    from sb3_progpolicy.evaluation import spec_of

    if name in gym.registry or not Path(name).exists():
        return Source(name, spec_of(name).id, None, None, {})
    return find_source(name)


Act = Callable[[Any, float, bool], Any]


def _policy(source: Source, semantics: Any) -> Act:
    if source.program is None:
        raise ValueError(f"{source.name} is not a program; render plays programs, planners and random actions")
    from sb3_progpolicy.programs.interpreter import ProgramRunner, join_inputs

    program, previous = source.program, None
    runner = ProgramRunner(program, 1, semantics)

    def act(observation: Any, reward: float, done: bool) -> Any:
        nonlocal previous
        previous = runner.act(join_inputs(program, observation, previous, reward, done))
        return previous[0]

    return act


def _random(env: Any) -> Act:
    return lambda observation, reward, done: env.action_space.sample()


def _planner(env: Any) -> Act:
    """The actions of the environment's own planner."""
    from progpolicy_envs import DOMAINS

    if not hasattr(env.unwrapped, "plan"):
        raise ValueError(f"--planner is not accepted for {env.spec.id}; it is for {', '.join(DOMAINS)}")
    planned = iter(env.unwrapped.plan())
    return lambda observation, reward, done: next(planned)


def _play(
    env: Any, act: Act, observation: Any, optimal: int | None, cap: int, show: Callable[[Any], None]
) -> tuple[int, bool]:
    from rich.console import Console
    from rich.progress import Progress

    reward, done, info, steps = 0.0, False, dict[str, Any](), 0
    show(env.render())
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("playing", total=optimal or cap)
        while not done:
            observation, reward, terminated, truncated, info = env.step(act(observation, reward, done))
            done = terminated or truncated
            steps += 1
            show(env.render())
            progress.advance(task)
    return steps, bool(info.get("is_success", False))


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


_FORMATS: dict[str, type[_Gif] | type[_Mp4]] = {".gif": _Gif, ".mp4": _Mp4}
