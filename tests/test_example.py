"""`xfemnav example`: the files of the examples, whole, and nothing of anybody's overwritten."""

import errno
import importlib.util
import os
import tomllib

import pytest
from small import xfemnav

from data_synthetic import files, phantom, surgery
from xfemnav.pipeline.asking.scenario import problems
from xfemnav.pipeline.keeping import disk


@pytest.fixture(scope="module")
def wanted(tmp_path_factory):
    """The files of each example, by its name."""
    home = tmp_path_factory.mktemp("wanted")
    files.write(phantom.Phantom(), home / "phantom")
    surgery.write(home / "surgery")
    return {name: held(home / name) for name in ("phantom", "surgery")}


def held(folder) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", ["phantom", "surgery"])
def test_an_example_is_written(tmp_path, capfd, wanted, name):
    code, stdout, stderr = xfemnav(capfd, "example", name, tmp_path / "a" / "b")
    assert (code, stderr) == (0, "") and held(tmp_path / "a" / "b") == wanted[name]
    assert sorted(stdout.splitlines()) == sorted(str(tmp_path / "a" / "b" / file) for file in wanted[name])
    assert xfemnav(capfd, "example", name, tmp_path / "a" / "b")[0] == 0, "the same again changes nothing"
    for path in (tmp_path / "a" / "b").glob("*.toml"):
        assert problems(tomllib.loads(path.read_text())) == []


@pytest.mark.parametrize("there", [lambda path: path.write_text("mine"), lambda path: path.mkdir(),
                                   lambda path: path.symlink_to("/etc/passwd"),
                                   lambda path: path.symlink_to("nowhere")])
def test_what_is_there_is_not_overwritten(tmp_path, capfd, wanted, there):
    there(tmp_path / "sub-phantom_T1w.nii.gz")
    code, _, stderr = xfemnav(capfd, "example", "phantom", tmp_path)
    assert code == 73 and stderr.startswith("E731 sub-phantom_T1w.nii.gz")
    assert os.listdir(tmp_path) == ["sub-phantom_T1w.nii.gz"]


def test_force_replaces_files(tmp_path, capfd, wanted):
    (tmp_path / "sub-phantom_T1w.nii.gz").write_text("mine")
    assert xfemnav(capfd, "example", "phantom", tmp_path, "--force")[0] == 0
    assert held(tmp_path) == wanted["phantom"]


def test_a_full_disk_leaves_nothing(tmp_path, capfd, monkeypatch):
    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(disk.os, "fsync", full)
    code, _, stderr = xfemnav(capfd, "example", "phantom", tmp_path / "out")
    assert code == 74 and stderr.startswith("E501 ") and held(tmp_path / "out") == {}


def test_without_nilearn_it_is_said_what_to_install(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr("xfemnav.pipeline.running.demo.find_spec", lambda name: None)
    code, _, stderr = xfemnav(capfd, "example", "surgery", tmp_path / "out")
    assert code == 66 and "pip install 'xfemnav[demo]'" in stderr and not (tmp_path / "out").exists()
