"""Threads are those of the session again after each test."""

import pytest
import torch

from pd4dgs_codec import threads


@pytest.fixture(autouse=True)
def _restore_threads():
    before, torch_before = threads.kernel_threads(), torch.get_num_threads()
    yield
    threads.set_kernel_threads(before)
    torch.set_num_threads(torch_before)
