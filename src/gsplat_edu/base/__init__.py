"""What everything else stands on: constants, errors, files, text, checks, threads and memory."""
