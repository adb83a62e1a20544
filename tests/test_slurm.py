"""The queue of Slurm: its commands as they answer, and where it can be set up a real one of one node."""

from __future__ import annotations

import csv
import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from test_sweep import RECIPE, SWEEP
from written_jobs import Exploding, written

from cirl_marl.errors import CirlError, RunError
from cirl_marl.jobs import JobStatus, run_jobs, slurm
from cirl_marl.jobs.slurm import Queue, sbatch_options
from cirl_marl.jobs.work import JobFiles
from cirl_marl.network import Network

TESTS = Path(__file__).parent
COMMANDS = {
    "sbatch": """
case "$*" in *partitoin*) echo "sbatch: unrecognized option '--partitoin=x'" >&2; exit 1;; esac
test "$1" = --test-only && exit 0
sh > /dev/null 2>&1
echo $? > "$FAKE/code"
echo 7""",
    "squeue": "exit 0",
    "scontrol": """
test -f "$FAKE/forgotten" && exit 1
code=$(cat "$FAKE/code")
ended=$(test "$code" = 0 && echo COMPLETED || echo FAILED)
echo "JobId=7 JobState=$(cat "$FAKE/state" 2> /dev/null || echo "$ended") ExitCode=$code:0" """,
    "sacct": "exit 1",
    "scancel": "exit 0",
}
"""Commands that answer as Slurm does; ``sbatch`` does the job at once."""


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Put commands before all others; their answers are files in the folder that is returned."""
    folder = tmp_path / "fake"
    folder.mkdir()
    for name, script in COMMANDS.items():
        (folder / name).write_text(f"#!/bin/sh\n{script}\n")
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", os.pathsep.join([str(folder), os.environ["PATH"]]))
    monkeypatch.setenv("FAKE", str(folder))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(TESTS), str(TESTS.parent)]))
    monkeypatch.setattr(slurm, "AGE", 0.0)
    return folder


@pytest.mark.medium
def test_jobs_in_the_queue(tmp_path: Path, fake: Path) -> None:
    """Who fails is named with what it said, the others are done, and pickles that somebody left there are not read."""
    jobs = tmp_path / "jobs"
    for place in (jobs / "slurm", jobs / ".slurm-abc", jobs):
        place.mkdir(exist_ok=True, parents=True)
        for name in ("7_0_result.pkl", "7_submitted.pkl", "a.pkl"):
            (place / name).write_bytes(pickle.dumps(Exploding(str(tmp_path / "exploded"))))
    words: list[str] = []
    failures = run_jobs(written(tmp_path, a="raise")[:2], jobs, on="slurm", workers=3, say=words.append)
    assert words == ["3 at a time in the queue of Slurm"]
    assert {failure.name: failure.message for failure in failures} == {"a": "ValueError: paper is out"}
    assert (tmp_path / "b.txt").is_file()
    assert [path.name for path in jobs.glob(".slurm-*")] == [".slurm-abc"]
    assert not (tmp_path / "exploded").exists()


@pytest.mark.medium
@pytest.mark.parametrize(
    ("state", "forgotten", "said"),
    [
        ("CANCELLED", False, "Slurm job 7: CANCELLED"),
        ("OUT_OF_MEMORY", False, "Slurm job 7: OUT_OF_MEMORY"),
        ("", True, "ended, and Slurm does not say how"),
    ],
)
def test_who_ends_without_being_done_is_noticed(
    state: str, forgotten: bool, said: str, tmp_path: Path, fake: Path
) -> None:
    """A cancelled job too, and one that nobody remembers, where there is no accounting."""
    (fake / "sbatch").write_text("#!/bin/sh\necho 7\n")
    if forgotten:
        (fake / "forgotten").touch()
    else:
        (fake / "state").write_text(state)
        (fake / "code").write_text("0")
    failures = run_jobs(written(tmp_path)[:1], tmp_path / "jobs", on="slurm")
    assert [failure.message for failure in failures] == [f"{said}: it said nothing"]


@pytest.mark.medium
@pytest.mark.parametrize("state", ["TIMEOUT", "PREEMPTED", "NODE_FAIL"])
def test_what_is_cut_off_goes_on(state: str, tmp_path: Path, fake: Path) -> None:
    """In another job, as often as it comes further; a job in which it did not is the last."""
    (job,) = written(tmp_path)[:1]
    told, code = tmp_path / "jobs" / "a.json", 'test -f "$FAKE/state" && rm "$FAKE/state"'
    (fake / "state").write_text(state)
    (fake / "code").write_text("0")
    advance = f"""echo '{{"what": "training", "done": 1, "total": 2}}' > {told}"""
    (fake / "sbatch").write_text(
        f"#!/bin/sh\ncase $1 in --test-only) exit 0;; esac\necho run >> $FAKE/runs\n"
        f'if [ $(wc -l < "$FAKE/runs") = 1 ]; then {advance}; else touch {job.file}; {code}; fi; echo 7\n'
    )
    assert run_jobs([job], tmp_path / "jobs", on="slurm") == []
    assert len((fake / "runs").read_text().splitlines()) == 2
    job.file.unlink()
    (fake / "state").write_text(state)
    (fake / "sbatch").write_text("#!/bin/sh\necho 7\n")
    (failure,) = run_jobs([job], tmp_path / "jobs", on="slurm")
    assert failure.message.startswith(f"came no further in a whole job ({state})")


def test_work_that_was_exchanged_is_not_read(tmp_path: Path) -> None:
    """The script of a job says what is in the file that it does."""
    from cirl_marl.jobs.worker import main

    file = tmp_path / "work.pkl"
    file.write_bytes(pickle.dumps(Exploding(str(tmp_path / "exploded"))))
    with pytest.raises(RunError, match="is not what was put into the queue"):
        main(file, "0" * 64)
    assert not (tmp_path / "exploded").exists()


def test_the_folder_of_a_driver_is_private(tmp_path: Path, fake: Path) -> None:
    """Nobody else may write there, and each driver has one of its own."""
    first, second = (slurm.Slurm(tmp_path / "jobs", None, {}) for _ in range(2))
    folders = sorted((tmp_path / "jobs").iterdir())
    assert len(folders) == 2
    assert all(folder.stat().st_mode & 0o777 == 0o700 for folder in folders)
    first.close()
    second.close()
    assert list((tmp_path / "jobs").iterdir()) == []


def test_a_controller_that_does_not_answer(fake: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is waited for, and given up with its words."""
    (fake / "squeue").write_text(
        "#!/bin/sh\necho 'slurm_load_jobs error: Unable to contact slurm controller' >&2; exit 1\n"
    )
    queue = Queue()
    queue.follow("7")
    assert queue.state("7") == "PENDING"
    monkeypatch.setattr(slurm, "SILENCE", 0.0)
    with pytest.raises(RunError, match=r"Slurm has not answered for 0 s: slurm_load_jobs error: Unable"):
        queue.state("7")


def test_settings(fake: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are long options of sbatch; what it does not know is refused in its words before anything is begun."""
    assert "--mem=4G" in sbatch_options({"mem_gb": "4"})
    assert {"--time=8", "--signal=B:TERM@120"} <= set(sbatch_options({"timeout_min": "8"}))
    assert "--signal=B:TERM@15" in sbatch_options({"time": "1"})
    assert sbatch_options({"slurm_cpus_per_task": "3"}) == sbatch_options({"cpus_per_task": "3"})
    for name in ("output", "slurm_wrap", "-p", "A", ""):
        with pytest.raises(CirlError, match=f"--slurm {name}=x: is no setting that can be given"):
            sbatch_options({name: "x"})
    with pytest.raises(
        CirlError, match=r"--slurm slurm_partitoin=x: Slurm says: .*unrecognized option '--partitoin=x'"
    ):
        run_jobs(written(tmp_path), tmp_path / "jobs", on="slurm", settings={"slurm_partitoin": "x"})
    assert not (tmp_path / "jobs").exists()
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(CirlError, match=r"there is no Slurm here \(no sbatch\); use --on local"):
        run_jobs(written(tmp_path), tmp_path / "jobs", on="slurm")


def test_a_queue_that_takes_no_jobs_is_said(tmp_path: Path, fake: Path) -> None:
    """A machine may have the commands of Slurm and no controller: what sbatch says stands in one line."""
    (fake / "sbatch").write_text("#!/bin/sh\necho 'sbatch: fatal: no configuration source' >&2\nexit 1\n")
    with pytest.raises(CirlError, match=r"^--on slurm: Slurm says: sbatch: fatal: no configuration source$"):
        run_jobs(written(tmp_path), tmp_path / "jobs", on="slurm")


MISSING = [name for name in ("slurmctld", "slurmd", "munged") if shutil.which(name) is None]
ACCOUNTING = [name for name in ("slurmdbd", "mariadbd") if shutil.which(name) is None]


@pytest.fixture(scope="module", params=["plain", "accounting"])
def node(request: pytest.FixtureRequest) -> Iterator[str]:
    """Set up a Slurm of one node, without and with accounting."""
    missing = MISSING + (ACCOUNTING if request.param == "accounting" else [])
    if missing or os.geteuid():
        pytest.skip(f"a Slurm of one node needs root and the programs {', '.join(missing) or 'that are there'}")
    before = os.environ.copy()
    # not among those of pytest, which any other session of pytest closes to the servers' own users
    with tempfile.TemporaryDirectory(prefix="slurm-", ignore_cleanup_errors=True) as folder:
        script = ["bash", str(TESTS / "slurm_node.sh"), folder, request.param]
        log = Path(folder) / "setup.log"
        try:
            with log.open("w") as file:  # servers keep it open, for which a pipe would wait
                done = subprocess.run(script, check=False, stdout=file, stderr=file, timeout=300)
            assert done.returncode == 0, log.read_text()
            os.environ["SLURM_CONF"] = f"{folder}/slurm.conf"
            os.environ["PYTHONPATH"] = os.pathsep.join([str(TESTS), str(TESTS.parent)])
            yield request.param
        finally:
            os.environ.clear()
            os.environ.update(before)
            subprocess.run([*script[:3], "stop"], check=True, capture_output=True)


@pytest.mark.slow
def test_a_real_slurm(node: str, tmp_path: Path) -> None:
    """Failures and deaths are named, and the same jobs are done at last."""
    failures = run_jobs(written(tmp_path, a="die", b="raise"), tmp_path / "jobs", on="slurm", workers=3)
    said = {failure.name: failure.message for failure in failures}
    assert said["b"] == "ValueError: paper is out"
    assert "FAILED by signal 9" in said["a"] and said["a"].endswith(": the pen breaks")
    settings = {"timeout_min": "5", "slurm_partition": "all"}
    assert run_jobs(written(tmp_path), tmp_path / "jobs", on="slurm", settings=settings) == []
    with pytest.raises(CirlError, match=r"--slurm partition=long: Slurm says: .*[Ii]nvalid partition"):
        run_jobs(written(tmp_path), tmp_path / "jobs", on="slurm", settings={"partition": "long"})


@pytest.mark.slow
def test_a_cancelled_job_is_noticed(node: str, tmp_path: Path) -> None:
    """Whoever takes it out of the queue ends it for the driver, too, with and without accounting."""
    begun = tmp_path / "a.begun"

    def watch(statuses: Sequence[JobStatus]) -> None:
        if begun.is_file():
            subprocess.run(["scancel", "--me"], check=True)

    (failure,) = run_jobs(written(tmp_path, a="wait")[:1], tmp_path / "jobs", on="slurm", watch=watch)
    assert "CANCELLED" in failure.message


@pytest.mark.slow
def test_a_job_at_its_time_limit_goes_on(node: str, tmp_path: Path) -> None:
    """It is told to save what it has, and another job does the rest."""
    if node == "accounting":
        pytest.skip("takes minutes, and is the same with accounting")
    (job,) = written(tmp_path, a="count")[:1]
    began = time.monotonic()
    assert run_jobs([job], tmp_path / "jobs", on="slurm", settings={"timeout_min": "1"}) == []
    assert len(job.file.with_suffix(".begun").read_text().splitlines()) >= 2, time.monotonic() - began
    assert json.loads(JobFiles(tmp_path / "jobs", "a").progress_file.read_text())["what"] == "done"


@pytest.mark.slow
def test_killed_drivers_change_nothing(node: str, bottles: Network, tmp_path: Path) -> None:
    """Killed when jobs wait, when one trains and when one is done, with its jobs: the table is that of ``local``."""
    if node == "accounting":
        pytest.skip("takes a minute, and is the same with accounting")
    assert bottles.source is not None
    (tmp_path / "bottles.toml").write_text(bottles.source.read_text())
    (tmp_path / "quick.toml").write_text(RECIPE.format(name="quick", algorithm="A2C", n_steps=5))
    (tmp_path / "sweep.toml").write_text(SWEEP)

    def sweep(on: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "cirl_marl.cli", "sweep", "sweep.toml", "--on", on, "--out", on]
        return subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL)

    def table(on: str) -> list[dict[str, str]]:
        with (tmp_path / on / "sweep.csv").open(newline="") as file:
            return [{key: cell for key, cell in row.items() if key != "cpu_seconds"} for row in csv.DictReader(file)]

    for sign in ("jobs/.slurm-*/*.pkl", "jobs/*-quick-*.json", "cells/*/result.json"):
        driver = sweep("slurm")
        late = time.monotonic() + 600.0
        while not any((tmp_path / "slurm").glob(sign)):
            assert time.monotonic() < late and driver.poll() is None, sign
            time.sleep(0.1)
        driver.kill()
        assert driver.wait() == -signal.SIGKILL
        subprocess.run(["scancel", "--me", "--state=RUNNING", "--signal=KILL"], check=True)
    assert sweep("slurm").wait() == 0
    assert sweep("local").wait() == 0
    assert table("slurm") == table("local")
    assert {row["state"] for row in table("slurm")} == {"done"}
