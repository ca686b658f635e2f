"""Which files of tests take longest."""

# By the processors' time in `make test` or `make test-deep`, whichever is more, down to 20 s. Two
# processes share the files, and one that begins a long file last leaves the other without work.
LONGEST_FILES = (
    "test_kernels.py",
    "cohort/test_cohort.py",
    "study/test_child.py",
    "test_scripts.py",
    "study/test_compare.py",
    "examples/test_examples.py",
    "hostile/test_hostile.py",
    "test_cli_domains.py",
    "test_cli.py",
    "test_reproduce_paper.py",
    "start/test_sizes.py",
    "test_workers.py",
    "io/test_zarr_chunks.py",
    "test_cli_ending.py",
    "test_interpreter.py",
    "job/test_job_run.py",
    "io/test_untrusted.py",
    "engine/test_thin_labels_engine.py",
    "fem/test_elasticity.py",
    "test_cli_tissues.py",
    "test_cli_convert.py",
    "fem/test_solution.py",
)
