"""The tests of gnn_policy run on one thread."""

import pytest
import torch


@pytest.fixture(autouse=True, scope="module")
def one_thread_to_begin_with():
    """For what fixtures of a module compute."""
    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def one_thread():
    """The commands set the number of threads of the process."""
    torch.set_num_threads(1)
