"""The other end of a queue: ``python -m cirl_marl.jobs.worker FILE SHA256`` does the work that a driver wrote."""

from __future__ import annotations

import hashlib
import pickle
import signal
import sys
from pathlib import Path

from cirl_marl.errors import RunError
from cirl_marl.jobs.work import EXIT_STOPPED, Work


def main(file: Path, sha256: str) -> None:
    """Do the work in ``file`` if it is what the driver wrote; end with ``STOPPED`` if told to stop before it is done.

    Raises:
        RunError: if the file is another than the one that was put into the queue; it is not read then.
    """
    payload = file.read_bytes()
    if hashlib.sha256(payload).hexdigest() != sha256:
        raise RunError(f"{file}: is not what was put into the queue")
    # written by the driver, as the hash in its script says
    work: Work = pickle.loads(payload)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C does
    try:
        work()
    except KeyboardInterrupt:
        sys.exit(EXIT_STOPPED)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
