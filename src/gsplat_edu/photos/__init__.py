"""Everything from an image file to pixels: recognised, decoded, turned, converted to sRGB, downscaled."""
