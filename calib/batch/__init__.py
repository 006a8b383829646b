"""Work spread over processes, folders that appear whole, campaigns of many tasks."""
