"""Files are on the disk before their names say so: what a power cut leaves is whole, or not there."""

import os

from xfemnav.pipeline.keeping import disk


def test_all_is_synced_before_anything_is_renamed_and_the_folder_after(tmp_path, monkeypatch):
    done, fsync, replace = [], os.fsync, os.replace
    files = {f"{k}.txt": bytes([k]) for k in range(3)}

    def synced(handle):
        done.append(os.readlink(f"/proc/self/fd/{handle}"))
        fsync(handle)

    def renamed(source, target):
        done.append((str(source), str(target)))
        replace(source, target)

    monkeypatch.setattr(disk.os, "fsync", synced)
    monkeypatch.setattr(disk.os, "replace", renamed)
    disk.write_together(tmp_path, files, before=lambda: done.append("before"))
    renames = done[len(files) + 1 : -1]
    assert done[: len(files)] == [source for source, _ in renames] and done[len(files)] == "before"
    assert [target for _, target in renames] == [str(tmp_path / name) for name in files]
    assert done[-1] == str(tmp_path) and {path.name: path.read_bytes() for path in tmp_path.iterdir()} == files


def test_only_what_we_have_left_half_written_goes(tmp_path):
    (tmp_path / "mine").write_text("kept")
    left, link, folder, other = (tmp_path / f".{name}{disk.TEMPORARY}" for name in ("7-0", "7-1", "7-2", "draft"))
    left.write_text("half")
    link.symlink_to("mine")
    folder.mkdir()
    other.write_text("somebody's")
    disk.remove_temporaries(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted([tmp_path / "mine", link, folder, other])
