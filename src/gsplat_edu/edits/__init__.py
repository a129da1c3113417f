"""Edits of a scene: operations in a JSON file, which the page's editor writes and `convert --edits` applies."""
