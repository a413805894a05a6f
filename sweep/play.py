"""`run.py play`: episodes of a trained policy, and a video of them."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np

import envs
from algos import Policy, load_policy
from core.words import ConfigError, parse_words, whole_number
from envs import ActionConstrainedEnv, InfeasibleActionError
from store.files import user_path
from sweep.exit import Exit

USAGE = "run.py play FOLDER [episodes=3] [which=best] [video=FILE.mp4]"

Film = Callable[[np.ndarray], None]
"""Takes the next picture (h, w, 3), uint8, of a video."""


def play(words: Sequence[str], stop_if_asked: Callable[[], None] = lambda: None) -> Exit:
    """Run and film the policy in a run's folder, as `USAGE` says, and print the return of each episode.

    The starts of the episodes are the same every time. A video shows the feasible set of a two-dimensional action.
    Raises ConfigError for wrong words, an existing video file, and a policy that cannot be played or filmed.
    """
    if not words or words[0].partition("=")[0] in ("episodes", "which", "video"):
        raise ConfigError(f"expected the folder of a run first ({USAGE})")
    settings = parse_words(words[1:], ("episodes", "which", "video"))
    episodes = whole_number("episodes", settings.get("episodes", "3"))
    video = user_path(settings["video"]) if "video" in settings else None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        policy = load_policy(words[0], settings.get("which", "best"))
    for warning in caught:
        print(f"note: {warning.message}", file=sys.stderr)
    with closing(_make_env(policy, filmed=video is not None)) as env:
        if video is None:
            _play_episodes(env, policy, episodes, stop_if_asked)
        else:
            with new_video(video, env.robot.fps) as film:
                _play_episodes(env, policy, episodes, stop_if_asked, film)
            print(f"{video}: {video.stat().st_size / 1e6:.1f} MB")
    return Exit.DONE


def _make_env(policy: Policy, filmed: bool) -> ActionConstrainedEnv:
    """The environment that the policy was trained in; its pictures show the set of a two-dimensional action."""
    config = policy.agent.config
    try:
        return envs.make(
            config.env,
            render_mode="rgb_array" if filmed else None,
            simulator=config.simulator,
            show_set=policy.constraint.dim == 2,
        )
    except envs.UnavailableError as error:
        raise ConfigError(str(error)) from error


def _play_episodes(
    env: ActionConstrainedEnv,
    policy: Policy,
    episodes: int,
    stop_if_asked: Callable[[], None],
    film: Film | None = None,
) -> None:
    returns = []
    for episode in range(episodes):
        obs, _ = env.reset(seed=episode)
        total, over = 0.0, False
        while not over:
            stop_if_asked()
            if film:
                film(_picture(env))
            try:
                obs, reward, terminated, truncated, _ = env.step(policy(obs))
            except InfeasibleActionError as error:
                raise ConfigError(f"the policy's action was refused: {error}") from error
            total, over = total + reward, terminated or truncated
        if film:
            film(_picture(env))
        returns.append(total)
        print(f"episode {episode + 1}: return {total:.2f} in {env.elapsed_steps} steps")
    print(f"mean return {np.mean(returns):.2f}; largest violation {env.largest_violation:.1e}")


def _picture(env: ActionConstrainedEnv) -> np.ndarray:
    try:
        return env.render()
    except RuntimeError as error:  # no OpenGL on this machine
        raise ConfigError(str(error)) from error


@contextmanager
def new_video(path: Path, fps: int) -> Iterator[Film]:
    """A new video file `path` (.mp4) with `fps` pictures a second, all of the size of the first one.

    Raises ConfigError if the file exists already, for another suffix, and without imageio-ffmpeg. An error while the
    video is open deletes the file.
    """
    try:
        import imageio_ffmpeg
    except ImportError:
        raise ConfigError("video= needs imageio-ffmpeg (pip install imageio-ffmpeg)") from None
    if path.suffix != ".mp4":
        raise ConfigError(f"bad value {str(path)!r} for video: expected a file name that ends in .mp4")
    if path.exists():
        raise ConfigError(f"{path} exists already; choose another name for video=, or delete it")
    if not path.parent.is_dir():
        raise ConfigError(f"bad value {str(path)!r} for video: there is no folder {path.parent}")
    writer = None

    def film(picture: np.ndarray) -> None:
        nonlocal writer
        if writer is None:
            height, width = picture.shape[:2]
            writer = imageio_ffmpeg.write_frames(str(path), (width, height), fps=fps, quality=8)
            writer.send(None)
        writer.send(np.ascontiguousarray(picture))

    try:
        yield film
    except BaseException:
        if writer is not None:
            writer.close()
        path.unlink(missing_ok=True)
        raise
    if writer is not None:
        writer.close()
