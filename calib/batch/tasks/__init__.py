"""Many independent tasks: on one process, on several, or on a Dask cluster, with the same results.

`run_tasks` and `run_folder_tasks` write one file or one folder for each task, and do only what is
missing when they are called again; `completed` hands results over as they come and writes nothing.
"""

from calib.batch.tasks.run import (
    Finished,
    LateItems,
    Outcome,
    alone,
    check_names,
    completed,
    failed_tasks,
    read_seconds,
    run_folder_tasks,
    run_tasks,
)

__all__ = [
    "Finished", "LateItems", "Outcome", "alone", "check_names", "completed",
    "failed_tasks", "read_seconds", "run_folder_tasks", "run_tasks",
]  # fmt: skip
