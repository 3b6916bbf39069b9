"""The pose of a shape over time.

Besides the public names, the command line may use `run_demo` and `DEMO_FPS`.
"""
