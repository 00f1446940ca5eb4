"""A run on many machines of a SLURM cluster: one command that all of them give, on one folder."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

GRACE = 60
"""How long before its end a job hears of it [s]."""


def sbatch_script(command: Sequence[str], machines: int, device: str, name: str) -> str:
    """A script for `sbatch`: an array of jobs that work in one folder and need no word with each other.

    A job that ends early is queued again and goes on. No port is opened between machines.

    Parameters
    ----------
    command
        What each machine runs, but for --workers.
    machines
        Jobs in the array.
    device
        "cpu": as many processes as the job has cores. "cuda": half again as many, which share the job's card.
    name
        Of the job.
    """
    on_card = device == "cuda"
    # A process takes 1 to 3 GB.
    asked = ["--gpus-per-task=1", "--mem-per-cpu=5G"] if on_card else ["--mem-per-cpu=4G"]
    workers = "$((SLURM_CPUS_PER_TASK * 3 / 2))" if on_card else "$SLURM_CPUS_PER_TASK"
    options = [
        f"--job-name={name}",
        f"--array=1-{machines}",
        "--ntasks=1",
        "--cpus-per-task=16",
        *asked,
        "--time=24:00:00",
        "--requeue",
        "--open-mode=append",
        f"--signal=B:TERM@{GRACE}",
    ]
    return "\n".join(
        [
            "#!/bin/bash",
            *(f"#SBATCH {option}" for option in options),
            "# Every job gives the same command: what is there is skipped, and what is missing is made.",
            f'exec {shlex.join(command)} --workers "{workers}"',
            "",
        ]
    )
