"""The runs of an experiment on SLURM: one array job, written to be submitted."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Sequence
from pathlib import Path

from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.runs.directory import IN_USE
from torchrl_etdmpc.runs.files import write_whole
from torchrl_etdmpc.suites.attempt import BEGUN, FAILED, command, log_file
from torchrl_etdmpc.suites.experiment import Run
from torchrl_etdmpc.training import EXIT_CODE

_LOOK_AGAIN_S = 30  # at a run that another process has
# SLURM sends the signal to the script alone (B:), which passes it on; `wait` returns when a trap has run, so it is
# asked again until the process is gone.
_BODY = """\
# {title}: {count} runs, one for each index of the array. A run that is stopped in time saves itself and leaves with
# exit code {code}: it goes back into the queue, and goes on from its directory.
set -u
cd {cwd} || exit 1
eval "set -- $(sed -n "$((SLURM_ARRAY_TASK_ID + 1))p" {commands})"
log=$1
shift
mkdir -p "$(dirname "$log")"
signal=
child=
trap 'signal=USR1; [ -n "$child" ] && kill -USR1 "$child" 2>/dev/null' USR1
trap 'signal=TERM; [ -n "$child" ] && kill -TERM "$child" 2>/dev/null' TERM  # cancelled: it is saved, and stays away
export OMP_NUM_THREADS="${{SLURM_CPUS_PER_TASK:-1}}"
say() {{  # in a line of its own: a process that was killed may have left one open
    [ -z "$(tail -c 1 "$log" 2> /dev/null)" ] || echo >> "$log"
    echo "$1" >> "$log"
}}

tries=0
furthest=0
while :; do
    say "{begun}"
    "$@" >> "$log" 2>&1 &
    child=$!
    code=0
    wait "$child" || code=$?
    while kill -0 "$child" 2>/dev/null; do
        code=0
        wait "$child" || code=$?
    done
    child=
    [ "$code" -eq 0 ] && exit 0
    case "$(tail -n 1 "$log")" in *"{in_use}"*)  # it is waited for
        if [ -z "$signal" ]; then
            sleep {pause} &
            wait "$!"
        fi
        [ -z "$signal" ] && continue ;;
    esac
    [ "$signal" = TERM ] && exit {code}
    if [ "$signal" = USR1 ] || [ "$code" -eq {code} ]; then
        scontrol requeue "$SLURM_JOB_ID"
        exit {code}
    fi
    tries=$((tries + 1))
    steps=$(tail -n 1 "$(dirname "$log")/{table}" 2> /dev/null | cut -d , -f 1)
    if [ "$steps" -gt "$furthest" ] 2> /dev/null; then  # it got further than the tries before
        tries=0
        furthest=$steps
    fi
    [ "$tries" -gt {retries} ] && break
done
say "{failed}$(tail -n 1 "$log" | sed 's/^error: //')"
exit "$code"
"""


def write_slurm_script(
    runs: Sequence[Run], folder: Path, title: str, *, sbatch: str = "", workers: int | None = None, retries: int = 2
) -> Path:
    """Writes ``slurm.sh`` and a table with the log and the command of each index into a folder.

    The table's name, ``slurm-DIGEST.txt``, follows from what it holds: SLURM keeps the script that was submitted, but
    an index reads its line when it starts, so a job that waits keeps its table whatever is written after it.

    Args:
        runs (sequence of Run): at least one; those that are finished when their turn comes cost seconds.
        folder (Path): the same on all nodes, as is the path of the Python environment.
        title (str): name of the job.

    Keyword Args:
        sbatch (str): options of sbatch, e.g. ``"--partition=gpu --gres=gpu:1 --time=12:00:00"``; ``--signal`` among
            them replaces ours, which comes 120 s before the end.
        workers (int, optional): runs at a time. Default: as many as SLURM lets.
        retries (int): tries of a run that fails without getting further, in the job that it has. Default: ``2``.

    Returns:
        Path: of the script.

    Raises:
        ValueError: if ``sbatch`` is not a list of options, or a path holds a line break.
        OSError: if the folder cannot be written.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from torchrl_etdmpc.suites import Experiment
    >>> folder = Path(tempfile.mkdtemp())
    >>> experiment = Experiment("heads", ("walker-walk",), (1, 2), {"cpu": {"preset": "cpu"}}, budget=50_000)
    >>> write_slurm_script(experiment.runs(folder), folder, "heads").name
    'slurm.sh'
    """
    try:
        own = shlex.split(sbatch)
    except ValueError as error:
        raise ValueError(f"sbatch must hold options such as '--time=12:00:00', got {sbatch!r}.") from error
    if any(not option.startswith("-") or "\n" in option for option in own):
        raise ValueError(f"sbatch must hold options written as --name=value, got {sbatch!r}.")
    at_a_time = f"%{workers}" if workers else ""
    options = [
        f"--job-name={title}",
        f"--array=0-{len(runs) - 1}{at_a_time}",
        "--requeue",
        "--open-mode=append",
        "--signal=B:USR1@120",
        f"--output={folder / 'slurm-%A_%a.out'}",
        *own,  # the last of two counts
    ]
    threads = " threads=${SLURM_CPUS_PER_TASK:-1}"  # for a run whose settings leave them open
    lines = [shlex.join([str(log_file(run)), *command(run)]) + threads * (run.config.threads is None) for run in runs]
    if any("\n" in line for line in lines):
        raise ValueError(
            "a path or a setting holds a line break, which the table of commands cannot; choose another runs_dir."
        )
    table = "\n".join(lines) + "\n"
    script = folder / "slurm.sh"
    commands = folder / f"slurm-{hashlib.sha256(table.encode()).hexdigest()[:8]}.txt"
    body = _BODY.format(
        title=title,
        count=len(runs),
        cwd=shlex.quote(str(Path.cwd())),
        commands=shlex.quote(str(commands)),
        begun=BEGUN,
        failed=FAILED,
        in_use=IN_USE,
        pause=_LOOK_AGAIN_S,
        table=RunDirectory(runs[0].path).train.name,
        retries=retries,
        code=EXIT_CODE,
    )
    write_whole(commands, table)
    write_whole(script, "\n".join(["#!/bin/bash", *(f"#SBATCH {shlex.quote(option)}" for option in options), body]))
    return script
