"""Work that is done once: in this process, on all cores of this machine, or on many machines.

A *job* knows whether it is done, and goes on where it was left. A *driver* (``run_jobs``) has what is missing done, at
a *place*; whoever works on a job holds its file lock, so any number of drivers may do the same jobs at once.
"""

from cirl_marl.jobs.driver import Failure, JobStatus, raise_first, run_jobs
from cirl_marl.jobs.places import PLACES, check_place
from cirl_marl.jobs.work import Job, Tell

__all__ = ["PLACES", "Failure", "Job", "JobStatus", "Tell", "check_place", "raise_first", "run_jobs"]
