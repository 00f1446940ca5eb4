"""Contents of damaged episode files."""

import h5py
import pytest
from test_scenes_windows import spoil
from tiny_episodes import write_episode

from scenes.episodes.reading.contents import read_contents
from sim.errors import InputError


def replaced(name, make):
    def how(file):
        del file[name]
        make(file)

    return how


BROKEN = {
    "external": (
        replaced("tip", lambda f: f.__setitem__("tip", h5py.ExternalLink("other.h5", "/x"))),
        "'tip' is a link",
    ),
    "soft": (replaced("tip", lambda f: f.__setitem__("tip", h5py.SoftLink("/force"))), "'tip' is a link"),
    "stored elsewhere": (
        replaced("tip", lambda f: f.create_dataset("tip", (7, 3), "f8", external=[("raw", 0, 168)])),
        "'tip' lies in another file",
    ),
    "huge": (
        replaced("tip", lambda f: f.create_dataset("tip", (7, 10**12), "f8", chunks=(1, 1000))),
        "larger than its file can hold",
    ),
    "other shape": (replaced("tip", lambda f: f.create_dataset("tip", (6, 3), "f8")), r"'tip' has shape \(6, 3\)"),
    "other kind": (replaced("tip", lambda f: f.create_dataset("tip", (7, 3), "S4")), "'tip' holds"),
    "no time": (replaced("time", lambda f: None), "no 'time'"),
    "size": (lambda f: f.attrs.__setitem__("width", 10**9), "1000000000 x"),
    "format": (lambda f: f.attrs.__setitem__("format", "sulcus data 2"), "it is no episode"),
    "long text": (lambda f: f.attrs.__setitem__("plan", "x" * 60_000), None),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_read_contents_rejects_damaged_episode_files(name, box, tmp_path):
    how, words = BROKEN[name]
    path = write_episode(tmp_path / "x.h5", box)
    spoil(path, how)
    if words is None:
        assert len(str(read_contents(path).attributes["plan"])) == 60_000
        return
    with pytest.raises(InputError, match=words) as caught:
        read_contents(path)
    assert str(caught.value).startswith(str(path))


def test_read_contents_rejects_truncated_hdf5_file(tmp_path, box):
    path = write_episode(tmp_path / "x.h5", box)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match=r"x.h5: cannot be read as an episode"):
        read_contents(path)
