"""Which files of tests take longest."""

# By their time. Two processes share the files, and one that begins a long file last leaves the other without work.
LONGEST_FILES = (
    "study/test_compare.py", "test_cli_ending.py", "examples/test_examples.py", "test_kernels.py",
    "cohort/test_cohort.py", "hostile/test_hostile.py", "test_scripts.py", "job/test_job_run.py",
    "study/test_program.py", "start/test_sizes.py", "test_cli_domains.py", "cohort/test_run.py", "test_readme.py",
    "hostile/test_faults.py", "test_interpreter.py", "test_systems.py", "test_doctests.py",
)  # fmt: skip
