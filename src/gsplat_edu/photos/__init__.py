"""Photos as files and as pixels: opening them within limits, and resizing."""
