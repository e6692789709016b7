"""The command line, and the edge where files are read and processes started."""
