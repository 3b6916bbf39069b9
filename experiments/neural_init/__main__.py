"""``python -m experiments.neural_init RESULTS``: final errors of a sweep's variants, and their numbers of steps."""

import sys

from ..neural_init.summary import main

if __name__ == "__main__":
    main(sys.argv[1:])
