"""Long work in processes of its own: commands as jobs with a record on disk, typed events, and a queue."""
