"""What measures and teaches the package and is not part of it: wheels do not contain it."""
