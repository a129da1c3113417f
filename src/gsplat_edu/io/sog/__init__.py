"""PlayCanvas' SOG, version 2."""
