"""A page that trains a scene in a browser tab: its scripts and the server of `gsplat-edu web`."""
