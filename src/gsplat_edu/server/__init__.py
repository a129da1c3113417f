"""A server for pages on this computer: its address, its guard, its limits, and the pages themselves."""
