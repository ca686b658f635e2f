"""Which files of tests take longest."""

# By their time. Two processes share the files, and one that begins a long file last leaves the other without work.
LONGEST_FILES = (
    "study/test_compare.py", "hostile/test_faults.py", "cohort/test_cohort.py", "hostile/test_hostile.py",
    "cluster/test_tasks.py", "cohort/test_run.py", "test_readme.py", "study/test_child.py", "random/test_random.py",
    "test_systems.py", "test_doctests.py",
)  # fmt: skip
