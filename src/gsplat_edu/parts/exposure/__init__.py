"""Exposure, white balance and vignetting of each photo."""
