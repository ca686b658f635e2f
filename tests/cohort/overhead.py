"""What dask costs a cohort of thousands: subjects that do nothing, through the loop that runs real ones.

Run by hand: python tests/cohort/overhead.py [SUBJECTS].
"""

import sys
import tempfile
import time
from pathlib import Path

from tetopt.cohort.run import Ended, SubjectTask, run_all
from tetopt.system.budget import resident_bytes
from tetopt.workers import Share, workers


def nothing(job: SubjectTask) -> Ended:
    return Ended(job.key, "done", "", 0.0, 0)


def main(n_subjects: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        words = ("--nodes=100000", "--iterations=20", "--", f"{folder}/a-usual-name-of-an-image_T1w.nii.gz")
        jobs = [SubjectTask(f"sub-{k:06d}", words, str(folder), ".vtu", 1, 1.0, "run-1") for k in range(n_subjects)]
        with workers(Share(2, 1, 1e9), None, 1) as pool:
            list(run_all(jobs[:100], pool, folder, nothing))  # what is imported once
            for part in range(1, 5):
                before, begin = resident_bytes(), time.monotonic()
                some = jobs[100 + (part - 1) * (n_subjects - 100) // 4 : 100 + part * (n_subjects - 100) // 4]
                assert sum(ended.status == "done" for ended in run_all(some, pool, folder, nothing)) == len(some)
                seconds = time.monotonic() - begin
                print(
                    f"{len(some)} subjects: {1e3 * seconds / len(some):.1f} ms each, process of {before / 1e6:.1f} MB "
                    f"grew by {(resident_bytes() - before) / len(some) / 1e3:.2f} kB each",
                    flush=True,
                )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2000)
