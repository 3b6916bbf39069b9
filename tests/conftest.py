"""One thread for torch: the problems here are small, and the tests may run beside others."""

import torch

torch.set_num_threads(1)
