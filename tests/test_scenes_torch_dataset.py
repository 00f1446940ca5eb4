"""Episodes for a data loader with several workers."""

import os

import pytest
import torch
from tiny_episodes import write_three_episodes
from torch.utils.data import DataLoader

from scenes import EpisodeDataset


@pytest.fixture(scope="module")
def folder(box, tmp_path_factory):
    return write_three_episodes(tmp_path_factory.mktemp("episodes"), box)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes that are forked")
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
@pytest.mark.filterwarnings("ignore::DeprecationWarning:multiprocessing.popen_fork")
@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_loader_workers_read_same_data_as_one_process(folder, start):
    data = EpisodeDataset(folder, ["colour", "tumour_predicted"], window=2, stride=2)
    assert isinstance(data[0]["colour"], torch.Tensor) and data.get_window(1, 3)["frame"].tolist() == [3, 4]
    alone = [data[index] for index in range(len(data))]
    loader = DataLoader(data, batch_size=1, num_workers=2, multiprocessing_context=start)
    together = list(loader)
    assert len(together) == len(alone) == 9
    for one, batch in zip(alone, together, strict=True):
        for name in ("colour", "tumour_predicted", "frame"):
            assert torch.equal(one[name], batch[name][0])
