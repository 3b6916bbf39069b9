"""Where trials run: on this machine, on a Ray cluster, under Slurm. Each engine turns jobs into outcomes."""
