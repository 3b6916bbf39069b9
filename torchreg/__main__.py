"""``python -m torchreg``: the command line."""

from torchreg.cli.application import main

if __name__ == "__main__":
    main()
