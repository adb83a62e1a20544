"""Jobs are done once, at whatever place; who dies is named, and the others go on."""

from __future__ import annotations

import importlib.util
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
from written_jobs import written

from cirl_marl import errors
from cirl_marl.definitions.code_permission import code_allowed
from cirl_marl.errors import CirlError, RunError
from cirl_marl.jobs import JobStatus, driver, places, raise_first, run_jobs
from cirl_marl.jobs.work import JobFiles

TESTS = Path(__file__).parent


def installed(package: str) -> pytest.MarkDecorator:
    """Skip where a package of an extra is not installed."""
    return pytest.mark.skipif(importlib.util.find_spec(package) is None, reason=f"{package} is not installed")


def test_jobs_are_done_once(tmp_path: Path) -> None:
    """What is there is left alone, what is missing is done, in order, and who watches sees the end of it."""
    jobs = written(tmp_path)
    jobs[1].file.write_text("0")
    seen: list[Sequence[JobStatus]] = []
    assert run_jobs(jobs, tmp_path / "jobs", watch=seen.append) == []
    assert [job.file.read_text() for job in jobs] == ["1", "0", "1"]
    assert [(each.name, each.state, each.share) for each in seen[-1]] == [(name, "done", 1.0) for name in "abc"]
    assert run_jobs(jobs, tmp_path / "jobs") == []
    assert [job.file.read_text() for job in jobs] == ["1", "0", "1"]
    with pytest.raises(CirlError, match=r"asked for more than once: b$"):
        run_jobs([*jobs, jobs[1]], tmp_path / "jobs")


def test_who_fails_is_named_and_the_others_go_on(tmp_path: Path) -> None:
    """In this process too; what was raised can be raised again. Who ends without being done has failed."""
    jobs = written(tmp_path, a="raise", b="forget")
    failures = run_jobs(jobs, tmp_path / "jobs")
    assert [str(each) for each in failures] == [
        "a: ValueError: paper is out",
        "b: RunError: b: came to its end without being done",
    ]
    assert jobs[2].is_done()
    with pytest.raises(ValueError, match="paper is out"):
        raise_first(failures)
    assert run_jobs(written(tmp_path), tmp_path / "jobs") == []
    assert jobs[0].file.read_text() == "2"


def test_what_is_claimed_is_waited_for(tmp_path: Path) -> None:
    """It is left to whoever has it; if that one leaves it undone, it is done here."""
    jobs = written(tmp_path)
    lock = JobFiles(tmp_path / "jobs", "a").lock()
    (tmp_path / "jobs").mkdir()
    lock.acquire()
    seen: list[dict[str, str]] = []

    def watch(statuses: Sequence[JobStatus]) -> None:
        seen.append({each.name: each.state for each in statuses})
        if seen[-1]["c"] == "done" and lock.is_locked:
            assert not jobs[0].is_done()
            lock.release()

    assert run_jobs(jobs, tmp_path / "jobs", watch=watch) == []
    assert {"a": "elsewhere", "b": "done", "c": "done"} in seen
    assert jobs[0].file.read_text() == "1"


def test_nobody_is_sent_for_what_is_claimed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process or a place in a queue would come for nothing; what was done elsewhere meanwhile needs none, either."""
    jobs = written(tmp_path)[:1]
    lock = JobFiles(tmp_path / "jobs", "a").lock()
    (tmp_path / "jobs").mkdir()
    lock.acquire()

    class Nowhere:
        workers, description = 1, "nowhere"

        def start(self, work: object) -> object:
            raise AssertionError("somebody was sent")

        def close(self) -> None:
            pass

    def watch(statuses: Sequence[JobStatus]) -> None:
        if statuses[0].state == "elsewhere" and lock.is_locked:
            jobs[0].file.write_text("by another")
            lock.release()

    monkeypatch.setattr(driver, "place_of", lambda *_: Nowhere())
    assert run_jobs(jobs, tmp_path / "jobs", watch=watch) == []
    assert jobs[0].file.read_text() == "by another"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.json", "[1, 2]"),
        ("a.json", "{"),
        ("a.json", '{"done": "half"}'),
        ("a.json", '{"done": 1, "total": 2, "cpu_seconds": null}'),
        ("b.json", '"' * 10_000),
    ],
)
def test_progress_that_no_job_told(name: str, content: str, tmp_path: Path) -> None:
    """A file of somebody else's is refused, named, and cited briefly."""
    (tmp_path / "jobs").mkdir()
    (tmp_path / "jobs" / name).write_text(content)
    with pytest.raises(RunError, match=rf"{name}: (is not what a job told|is no JSON object|cannot be read)") as error:
        raise_first(run_jobs(written(tmp_path), tmp_path / "jobs"))
    assert len(str(error.value)) < 400


@pytest.mark.parametrize("name", ["a.log", "a.json", ".a.lock", "below/link"])
def test_links_are_not_followed(name: str, tmp_path: Path) -> None:
    """What a link in the folder of jobs leads to is neither emptied nor written."""
    outside, link = tmp_path / "outside", tmp_path / "jobs" / name
    outside.write_text("precious")
    link.parent.mkdir(parents=True)
    link.symlink_to(outside)
    with pytest.raises(RunError, match=rf"{name}: is a link"):
        run_jobs(written(tmp_path), tmp_path / "jobs")
    assert outside.read_text() == "precious"
    assert not (tmp_path / "a.txt").exists()


@pytest.mark.medium
def test_a_worker_that_dies_is_named_with_what_it_said(tmp_path: Path) -> None:
    """Its job alone is not done; an exception elsewhere is reported in its own words."""
    jobs = written(tmp_path, a="die", b="raise")
    said: list[str] = []
    failures = run_jobs(jobs, tmp_path / "jobs", on="local", workers=2, say=said.append)
    assert said == ["2 at a time on this machine"]
    found = {each.name: each.message for each in failures}
    assert found == {"a": "killed by SIGKILL: the pen breaks", "b": "ValueError: paper is out"}
    assert 'raise ValueError("paper is out")' in (tmp_path / "jobs" / "b.log").read_text()
    assert jobs[2].is_done()
    with pytest.raises(RunError, match=r"killed by SIGKILL: the pen breaks \(log: .*a.log\)|paper is out"):
        raise_first(failures)
    assert [(tmp_path / f"{name}.begun").is_file() for name in "abc"] == [True] * 3
    assert run_jobs(written(tmp_path), tmp_path / "jobs") == []


DRIVE = """
import signal
import sys
from pathlib import Path
from written_jobs import written
from cirl_marl.jobs import run_jobs
folder = Path(sys.argv[1])
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    run_jobs(written(folder, a="wait"), folder / "jobs", on="local", workers=1)
"""


@pytest.mark.medium
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
@pytest.mark.parametrize(
    "how", [signal.SIGKILL, pytest.param(signal.SIGINT, marks=pytest.mark.slow)], ids=["killed", "interrupted"]
)
def test_workers_end_with_their_driver(how: signal.Signals, tmp_path: Path) -> None:
    """Nobody works on for a driver that is gone, and what it had claimed is free."""
    script = tmp_path / "drive.py"
    script.write_text(DRIVE)
    paths = os.pathsep.join([str(TESTS), str(TESTS.parent)])
    process = subprocess.Popen(
        [sys.executable, script, tmp_path], env=os.environ | {"PYTHONPATH": paths}, stderr=subprocess.DEVNULL
    )
    begun, files = tmp_path / "a.begun", JobFiles(tmp_path / "jobs", "a")
    wait_until(lambda: begun.is_file() and bool(begun.read_text()))
    worker = int(begun.read_text())
    process.send_signal(how)
    process.wait()
    wait_until(lambda: not is_alive(worker))
    wait_until(lambda: not files.is_claimed())  # the last of its threads, not the first, closes the file of the lock
    assert run_jobs(written(tmp_path), tmp_path / "jobs") == []
    assert (tmp_path / "a.txt").read_text() == "2"


def wait_until(true: object) -> None:
    """Wait five minutes at most, since machines are shared."""
    late = time.monotonic() + 300
    while not true():  # type: ignore[operator]
        assert time.monotonic() < late
        time.sleep(0.05)


def is_alive(process: int) -> bool:
    """Return whether a process of another parent runs; nobody may have asked a dead one for its exit code."""
    status = Path(f"/proc/{process}/stat")
    if status.parent.parent.is_dir():
        return status.is_file() and status.read_text().rpartition(")")[2].split()[0] != "Z"
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"on": "locl"}, r"unknown place 'locl'. Did you mean 'local'\? Known: here, local, slurm, ray."),
        ({"on": "here", "workers": 2}, "there is one worker, not 2; use --on local"),
        ({"on": "local", "workers": 0}, "workers must be a whole number of at least 1, got 0"),
        (
            {"on": "local", "settings": {"slurm_partition": "long"}},
            "--slurm slurm_partition=long: goes with --on slurm",
        ),
        ({"on": "slurm", "settings": {"output": "x"}}, "--slurm output=x: is no setting that can be given"),
        ({"on": "ray"}, r"--on ray needs the package ray, .* pip install 'cirl-marl\[ray\]'"),
    ],
)
def test_places_that_cannot_be(
    options: dict[str, object], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is begun, and the words say what to do."""
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(CirlError, match=message):
        run_jobs(written(tmp_path), tmp_path / "jobs", **options)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def test_logs_of_a_node_that_dies_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """What Ray prints of one is that it is dead, unless the user wants it otherwise."""
    seen: list[str] = []
    key = "RAY_DEDUP_LOGS_SKIP_REGEX"
    monkeypatch.setattr(errors, "import_module", lambda name: seen.append(os.environ[key]))
    monkeypatch.setenv(key, "mine")
    places.check_place("ray")
    monkeypatch.delenv(key)
    places.check_place("ray")
    assert seen[0] == "mine"
    assert re.search(seen[1], "Raylet is terminated. Termination is unexpected. Last 20 lines of the Raylet logs:")
    assert not re.search(seen[1], "The node with node id: 1 has been marked dead because the detector has missed too")


@pytest.mark.slow
@installed("ray")
def test_ray(tmp_path: Path) -> None:
    """A cluster of this machine does the same, in processes of their own."""
    script = tmp_path / "ray.py"
    script.write_text(RAY)
    paths = os.pathsep.join([str(TESTS), str(TESTS.parent)])
    done = subprocess.run(
        [sys.executable, script, tmp_path],
        env=os.environ | {"PYTHONPATH": paths},
        check=False,
        capture_output=True,
        text=True,
    )
    first, *lines = [line for line in done.stdout.splitlines() if "(raylet)" not in line]
    assert "at a time on the Ray cluster, which has" in first
    assert lines[:2] == ["a: the pen breaks", "b: ValueError: paper is out"], done.stderr
    assert lines[2:] == ["[]"], done.stderr
    assert [(tmp_path / f"{name}.txt").read_text() for name in "abc"] == ["2", "2", "1"]
    assert len(set((tmp_path / "a.begun").read_text().splitlines())) == 2


RAY = """
import sys
from pathlib import Path
sys.path.remove(str(Path(__file__).parent))  # it has the name of the package
from written_jobs import written
from cirl_marl.jobs import run_jobs
folder = Path(sys.argv[1])
failures = run_jobs(written(folder, a="die", b="raise"), folder / "jobs", on="ray", say=print)
for each in sorted(failures, key=lambda each: each.name):
    print(f"{each.name}: {each.message.rpartition(': ')[2] if each.name == 'a' else each.message}")
print(run_jobs(written(folder), folder / "jobs", on="ray"), flush=True)
"""


def test_the_leave_to_import_goes_along(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers may import what their driver may, and count paths from where it is."""
    sent = []

    class Post:
        workers, description = 1, "by post"

        def start(self, work: object) -> object:
            sent.append(work)
            raise KeyboardInterrupt

        def close(self) -> None:
            pass

    monkeypatch.setattr(driver, "place_of", lambda *_: Post())
    monkeypatch.chdir(tmp_path)
    for allowed in (False, True):
        with code_allowed(allowed), pytest.raises(KeyboardInterrupt):
            run_jobs(written(tmp_path), tmp_path / "jobs", on="local")
    assert [each.allow_code for each in sent] == [False, True]  # type: ignore[attr-defined]
    assert {each.directory for each in sent} == {str(tmp_path)}  # type: ignore[attr-defined]
