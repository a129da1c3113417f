"""Sources of views: captures on disk, and procedural scenes."""
