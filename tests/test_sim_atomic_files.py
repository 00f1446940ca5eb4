"""Files that are complete or absent: no partial files of killed runs, and full disks are reported."""

import os
import platform
import re
import subprocess
import sys
import time
import zlib
from pathlib import Path

import pytest
from limits import files_below

from sim.errors import InputError
from sim.runtime.atomic_files import check_disk_space, check_output, write_atomically, write_stream_atomically


class TestWriting:
    LEAVING = "import os, sys; from sim.runtime.atomic_files import write_atomically\n"
    LEAVING += "with write_atomically(sys.argv[1], '.txt') as p:\n"
    LEAVING += " p.write_text('half'); os.kill(os.getpid(), 9)"

    def test_partial_file_of_killed_run_is_removed_by_next_run(self, tmp_path: Path) -> None:
        path = tmp_path / "a.txt"
        house = Path(__file__).parents[1]
        done = subprocess.run([sys.executable, "-c", self.LEAVING, str(path)], cwd=house, check=False)
        (left,) = tmp_path.iterdir()
        assert done.returncode == -9 and left.read_text() == "half"
        living = left.with_name(re.sub(r"-\d+-a", f"-{os.getppid()}-a", left.name))
        other = left.with_name(left.name.replace("a.txt", "b.txt"))
        elsewhere = left.with_name(left.name.replace(f"{zlib.crc32(platform.node().encode()):08x}", "0" * 8))
        for file in (living, other, elsewhere):
            file.write_text("not ours")
        with write_atomically(path, ".txt") as partial:
            assert not left.exists()
            partial.write_text("whole")
        assert sorted(tmp_path.iterdir()) == sorted([path, living, other, elsewhere])
        for hours in (0.0, 23.0):
            os.utime(elsewhere, (time.time() - hours * 3600.0,) * 2)
            check_output(path, ".txt")
            assert elsewhere.exists()
        yesterday = time.time() - 25 * 3600.0
        for file in (living, other, elsewhere):
            os.utime(file, (yesterday, yesterday))
        check_output(path, ".txt")  # of another machine nothing is known but that it has written nothing for a day
        assert sorted(tmp_path.iterdir()) == sorted([path, living, other])

    @pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="no such file system")
    def test_output_to_proc_folder_is_rejected_before_work(self) -> None:
        with pytest.raises(InputError, match=r"cannot be written there \(No such file or directory\)"):
            check_output("/proc/a.txt", ".txt")

    def test_write_error_of_stream_is_reported_at_the_end(self, tmp_path: Path) -> None:
        with files_below(100_000):
            with (
                pytest.raises(InputError, match="File too large"),
                write_stream_atomically(tmp_path / "a.h5", ".h5") as file,
            ):
                assert file.write(bytes(200_000)) == 200_000
                file.seek(0)
            with pytest.raises(InputError, match=r"files are limited to 0\.1 MB"):
                check_disk_space(tmp_path / "a.h5", 1, 200_000)
            check_disk_space(tmp_path / "a.h5", 1, 50_000)
        assert not list(tmp_path.iterdir())

    def test_library_write_error_hides_internal_message(self, tmp_path: Path) -> None:
        with pytest.raises(InputError) as caught, write_atomically(tmp_path / "a.h5", ".h5"):
            raise OSError("Unable to synchronously create file (errno = 2, flags = 13)")
        assert "flags" not in str(caught.value)


def test_output_path_at_folder_or_below_file_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "folder.vtu").mkdir()
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        check_output(tmp_path / "folder.vtu", ".vtu")
    with pytest.raises(InputError, match="cannot be created"):
        check_output(tmp_path / "file" / "a.vtu", ".vtu")


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes anywhere")
def test_output_to_read_only_folder_is_rejected(tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o500)
    with pytest.raises(InputError, match="cannot be written"):
        check_output(closed / "a.vtu", ".vtu")
