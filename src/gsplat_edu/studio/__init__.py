"""The studio: a server for one browser page that takes photos to a finished scene; every long step is a job."""
