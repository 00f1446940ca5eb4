"""Bodies and episodes of a few numbers, for tests of what makes thousands of them."""

import errno
import os
import time
from dataclasses import dataclass, field
from functools import partial

import h5py
import numpy as np

from scenes.episodes.engine import list_missing_episodes, make_episodes
from scenes.episodes.run_folder import BODIES, RunSettings, begin_run, get_versions, list_finished, to_episode_name
from scenes.episodes.tasks import MadeEpisode, RunWork
from sim.runtime.atomic_files import write_stream_atomically

PER_BODY = 5
CARD = "CUDA_VISIBLE_DEVICES"


@dataclass(frozen=True)
class Trouble:
    """What goes wrong, by number of an episode: words of a failure, or the kind of an error; and of bodies."""

    episodes: dict = field(default_factory=dict)
    bodies: dict = field(default_factory=dict)
    seconds: float = 0.0


def body_of(number):
    return number // PER_BODY


def write(path, values):
    with write_stream_atomically(path, path.suffix, remove_partials=False) as stream, h5py.File(stream, "w") as file:
        for name, value in values.items():
            file[name] = value
    return MadeEpisode(path, len(values), path.stat().st_size)


def to_body_path(folder, number):
    return folder / BODIES / f"{number:04d}" / "body.h5"


def make_body(folder, seed, trouble, number):
    path = to_body_path(folder, number)
    if number in trouble.bodies:
        return MadeEpisode(path, failed=trouble.bodies[number])
    if path.exists():
        return MadeEpisode(path, skipped=True)
    return write(path, {"body": np.random.default_rng([seed, number]).random(50)})


def make_episode(folder, seed, trouble, number):
    path = folder / to_episode_name(number)
    if path.exists():
        return MadeEpisode(path, skipped=True)
    wrong = trouble.episodes.get(number, "")
    with (folder / "tried.txt").open("a") as file:
        file.write(f"{number} {os.getpid()} {os.environ.get(CARD)}\n")
    if wrong == "full":
        raise OSError(errno.ENOSPC, "No space left on device")
    if wrong == "broken":
        raise RuntimeError("the card has failed")
    if wrong == "broken once" and sum(line.startswith(f"{number} ") for line in tried(folder)) == 1:
        raise RuntimeError("the card has failed")
    if wrong.startswith("does not"):
        return MadeEpisode(path, failed=wrong)
    with h5py.File(to_body_path(folder, body_of(number))) as file:
        body = np.asarray(file["body"])
    time.sleep(trouble.seconds)
    frames = np.random.default_rng([seed, number]).random((3, 4096)) + body[0]
    return write(path, {f"frame{k}": frame for k, frame in enumerate(frames)})


def tried(folder):
    """What was tried: number, process and card of each attempt."""
    return (folder / "tried.txt").read_text().splitlines()


def tiny_work(folder, trouble=None, seed=1):
    given = folder, seed, trouble or Trouble()
    return RunWork(body_of, partial(make_body, *given), partial(make_episode, *given))


def tiny_run(seed=1, device="cpu", **changed):
    usual = {"digest": "0123456789abcdef", "seed": seed, "device": device, "versions": get_versions()}
    return RunSettings("tiny", **{**usual, **changed})


def played(folder, workers, count, trouble=None, heard=lambda *words: None, again=False):
    """A run as the command makes one."""
    run = tiny_run(device=workers.device)
    first = begin_run(folder, run, 'title = "tiny"\n')
    there, missing = list_missing_episodes(folder, list_finished(folder), range(count), first, again)
    return make_episodes(tiny_work(folder, trouble), folder, run, missing, workers, heard, there)


def held(folder):
    """Every episode's bytes, by name."""
    return {path.name: path.read_bytes() for path in sorted(folder.glob("episode_*.h5"))}
