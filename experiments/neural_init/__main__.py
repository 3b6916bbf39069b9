"""``python -m experiments.neural_init RESULTS``: what the variants of a sweep reached, and after how many steps."""

import sys

from experiments.neural_init.summary import main

if __name__ == "__main__":
    main(sys.argv[1:])
