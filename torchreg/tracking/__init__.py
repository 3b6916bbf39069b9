"""The pose of a shape over time.

Besides the public names, the command line may use `run_demo`, `moved_to_mean` and `DEMO_FPS`.
"""
