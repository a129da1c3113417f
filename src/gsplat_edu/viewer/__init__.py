"""Looking at scenes: a page for any browser, and a live view of a training."""
