"""Limits of processes, clusters and disks, with the test that would notice another value."""

WINDOW = 500  # tasks at a scheduler; enough for a large cluster and few for memory; test_cluster
CONNECT_SECONDS = 10  # s; a scheduler that runs answers at once; test_cluster
CLOSE_SECONDS = 20  # s; a worker that was starting is up by then; test_cluster
ROOM_BYTES = 16_000_000  # bytes; a folder with posteriors takes some megabytes; test_folders
YOUNG_SECONDS = 60.0  # s; a scratch folder may not have its lock before; test_folders
