"""Pruning under attack: whatever is put into a cache, or given as one, nothing that the cache has not made is touched.
"""

import multiprocessing
import os
import pwd
import shutil
import socket
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import pytest
from small import CUT, OPEN, QUICK, write, xfemnav
from test_cache import KEY, build, refuse, tree

from xfemnav.errors import XfemnavError
from xfemnav.pipeline.keeping import cache_layout, kernels
from xfemnav.pipeline.keeping.cache import Cache
from xfemnav.pipeline.keeping.cache_layout import TAG, TAGGED
from xfemnav.pipeline.keeping.disk import remove_temporaries
from xfemnav.pipeline.keeping.keys import canonical, digest

GROUP, FOREIGN_TAG = KEY[:2], b"Signature: 8a477f597d28d172789f06886806bc55\n# of another program\n"
ENTRY = f"entries/{GROUP}/{KEY}"


def held(root):
    """What is in a folder and below it, links and pipes too: kind and permissions, and the bytes of files."""
    found = {}
    for path in sorted(root.rglob("*")):
        status = path.lstat()
        regular = path.is_file() and not path.is_symlink()
        found[str(path.relative_to(root))] = (status.st_mode, path.read_bytes() if regular else None)
    return found


def put(root, *names):
    """Files of the user's with these names."""
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("mine")


def pipe(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    os.mkfifo(path)


def plug(path):
    """A socket, by a short name: theirs are 107 bytes at most."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as short, socket.socket(socket.AF_UNIX) as made:
        made.bind(f"{short}/s")
        os.rename(f"{short}/s", path)


def tagged_elsewhere(root):
    (root.parent / "tag").write_bytes(TAGGED)
    (root / TAG).symlink_to(root.parent / "tag")


#: What makes a folder the user's own; most of it looks like ours.
OWN = {
    "a study": lambda root: put(root, "sub-01/anat/sub-01_T1w.nii.gz", "participants.tsv"),
    "one file": lambda root: put(root, "notes.txt"),
    "a hidden file": lambda root: put(root, ".git/config"),
    "a store of blobs": lambda root: put(root, ENTRY),
    "a store of folders": lambda root: put(root, f"{ENTRY}/thesis.txt"),
    "a manifest of something else": lambda root: put(root, f"{ENTRY}/manifest.json", f"{ENTRY}/data.bin"),
    "a manifest of another key": lambda root: (put(root, f"{ENTRY}/data.bin"), (root / ENTRY / "manifest.json")
                                               .write_bytes(canonical({"key": digest(1), "files": {"data.bin": ""}}))),
    "a file beside public ones": lambda root: put(root, f"{ENTRY}/value.json", f"{ENTRY}/public/diary.txt"),
    "keys that are no locks": lambda root: put(root, f"locks/{KEY}"),
    "damaged ones of the user's": lambda root: put(root, f"damaged/{KEY}-0/photo.jpg"),
    "unfinished ones of the user's": lambda root: put(root, f"entries/{GROUP}/.{KEY}.xfemnav-tmp/draft.txt"),
    "a tag of another program": lambda root: (root / TAG).write_bytes(FOREIGN_TAG),
    "a tag with more in it": lambda root: (root / TAG).write_bytes(TAGGED + b"mine"),
    "a tag that is a link": tagged_elsewhere,
    "a tag that is a folder": lambda root: (root / TAG).mkdir(),
    "a tag that is a pipe": lambda root: pipe(root / TAG),
    "a tag that is a socket": lambda root: plug(root / TAG),
    "a part that is a file": lambda root: put(root, "entries"),
    "a part that is a pipe": lambda root: pipe(root / "locks"),
    "a part that is a socket": lambda root: plug(root / "damaged"),
    "a group that is a file": lambda root: put(root, f"entries/{GROUP}"),
    "a pipe among locks": lambda root: pipe(root / "locks" / KEY),
    "in-use that is a link": lambda root: (root / "in-use").symlink_to("/etc/hostname"),
}


@pytest.mark.parametrize("kind", OWN)
def test_a_folder_of_the_users_own_is_refused_as_it_is(tmp_path, capfd, kind):
    root = tmp_path / "own"
    root.mkdir()
    OWN[kind](root)
    before = held(root)
    with pytest.raises(XfemnavError, match=r"E504.*no cache of xfemnav"):
        Cache(root)
    code, _, stderr = xfemnav(capfd, "cache", "prune", "--days", "0", "-w", root)
    assert code == 73 and stderr.startswith("E504") and held(root) == before


def precious_in(folder):
    """A folder of the user's that looks like a group of entries, and what is in it."""
    put(folder / "precious", "diary.txt", f"{KEY}/value.npz", f"{KEY}/manifest.json", f"{KEY}/public/mask.nii.gz",
        f"{KEY}-0/facts.json", f".{KEY}.xfemnav-tmp/facts.json")
    return folder / "precious"


def made(root, *values):
    """A cache with an entry for each value, and the folders of the entries."""
    cache = Cache(root)
    return cache, [cache.obtain(digest(value), build)[0].folder for value in values]


def entry(root):
    """The folder of the entry of "one"."""
    key = digest("one")
    return root / "entries" / key[:2] / key


def link_group(root, precious):
    (root / "entries" / "zz").symlink_to(precious)
    (root / "entries" / "ff").symlink_to(precious)


def hard_link(root, precious):
    """An entry whose file is another name of the user's file: that name alone goes."""
    os.link(entry(root) / "value.npz", precious / "kept.npz")


#: What is put into a cache of ours, and whether the entry that is in it stays for it.
INSIDE = {
    "a link for a group": (link_group, False),
    "a link for an entry": (lambda root, precious: (root / "entries" / "fe").mkdir() or (
        root / "entries" / "fe" / ("fe" * 32)).symlink_to(precious / KEY), False),
    "a link among the damaged": (lambda root, precious: (root / "damaged" / f"{KEY}-0").symlink_to(precious), False),
    "a link among the locks": (lambda root, precious: (root / "locks" / ("fe" * 32)).symlink_to(
        precious / "diary.txt"), False),
    "a lock with words in it": (lambda root, precious: put(root, f"locks/{'fe' * 32}"), False),
    "a link to a folder in an entry": (lambda root, precious: (entry(root) / "mine").symlink_to(precious), True),
    "a link for a folder of an entry": (lambda root, precious: shutil.rmtree(entry(root) / "public") or (
        entry(root) / "public").symlink_to(precious), True),
    "a link to a file in an entry": (lambda root, precious: (entry(root) / "facts.json").symlink_to(
        precious / "diary.txt"), True),
    "a link for a file of an entry": (lambda root, precious: (entry(root) / "value.npz").unlink() or (
        entry(root) / "value.npz").symlink_to(precious / "diary.txt"), True),
    "a link that leads nowhere": (lambda root, precious: (entry(root) / "x").symlink_to("nowhere"), True),
    "a hard link": (hard_link, False),
    "a pipe in an entry": (lambda root, precious: pipe(entry(root) / "facts.json"), True),
    "a socket in an entry": (lambda root, precious: plug(entry(root) / "facts.json"), True),
    "a file in an entry": (lambda root, precious: put(entry(root), "public/notes.txt"), True),
    "a folder in an entry": (lambda root, precious: put(entry(root), "thesis/chapter.tex"), True),
    "a manifest that is a pipe": (lambda root, precious: (entry(root) / "manifest.json").unlink() or pipe(
        entry(root) / "manifest.json"), True),
    "a pipe among the locks": (lambda root, precious: pipe(root / "locks" / ("fe" * 32)), False),
    "files beside everything": (lambda root, precious: put(root, "notes.txt", "entries/x", "damaged/x", "locks/x",
                                                           f"{entry(root).parent.relative_to(root)}/x"), False),
    "folders of our names, with the user's in them": (lambda root, precious: put(
        root, f"damaged/{KEY}-0/a", f"entries/{GROUP}/{KEY}/a", f"entries/{GROUP}/.{KEY}.xfemnav-tmp/a"), False),
}


@pytest.mark.parametrize("kind", INSIDE)
def test_nothing_foreign_goes_with_a_cache(tmp_path, capfd, kind):
    """What is the user's is there afterwards, byte for byte, and all that is the cache's is gone."""
    cache, (folder,) = made(tmp_path / "cache", "one")
    own, precious = set(held(cache.root)), precious_in(tmp_path)
    attack, stays = INSIDE[kind]
    attack(cache.root, precious)
    before, outside = held(cache.root), held(precious)
    code, stdout, stderr = xfemnav(capfd, "cache", "prune", "--days", "0", "-w", cache.root)
    after = held(cache.root)
    assert code == 0 and held(precious) == outside
    assert all(after.get(name) == before[name] for name in before.keys() - own)
    assert folder.exists() == stays and ("is kept: it holds" in stderr) == (stays or "our names" in kind)
    assert ("1 entries removed" in stdout) != stays
    assert not stays or all(after.get(name) == before.get(name) for name in own if name.startswith("entries"))


def test_a_cache_behind_a_link_is_pruned_as_itself(tmp_path):
    """Caches are often put on another disk so; what the link leads to must be a cache."""
    made(tmp_path / "disk" / "cache", "one")
    (tmp_path / "home").symlink_to(tmp_path / "disk" / "cache")
    put(tmp_path / "disk", "diary.txt")
    assert Cache(tmp_path / "home").prune(0).entries == 1 and (tmp_path / "disk" / "diary.txt").exists()
    (tmp_path / "other").symlink_to(tmp_path / "disk")
    with pytest.raises(XfemnavError, match=r"E504.*diary\.txt|E504.*cache"):
        Cache(tmp_path / "other")


def test_a_cache_whose_place_another_folder_has_taken_is_not_pruned(tmp_path):
    """Between opening a cache and pruning it, its folder may be swapped."""
    cache, _ = made(tmp_path / "cache", "one")
    cache.root.rename(tmp_path / "away")
    put(cache.root, f"{ENTRY}/thesis.txt", "in-use")
    before = held(cache.root)
    with pytest.raises(XfemnavError, match="E504"):
        cache.prune(0)
    assert held(cache.root) == before


@pytest.mark.parametrize("swapped", ["group", "entry", "public", "root", "entries"])
def test_a_link_put_in_the_way_while_pruning_leads_nowhere(tmp_path, monkeypatch, swapped):
    """After all has been looked at, and before it is removed, a folder is replaced by a link to one like it."""
    cache, (folder,) = made(tmp_path / "cache", "one")
    key, group = folder.name, folder.parent
    precious = tmp_path / "precious"
    place = {"root": cache.root, "entries": cache.root / "entries", "group": group, "entry": folder,
             "public": folder / "public"}[swapped]
    shutil.copytree(place, precious)
    outside, real = held(precious), cache_layout.stranger

    def swap(name, within, ours):
        found = real(name, within, ours)
        if name == key and not place.is_symlink():
            place.rename(tmp_path / "away")
            place.symlink_to(precious)
        return found

    monkeypatch.setattr(cache_layout, "stranger", swap)
    cache.prune(0)
    assert place.is_symlink() and held(precious) == outside


def test_a_race_of_links_is_never_won(tmp_path):
    """Another process swaps a group of entries with a link to the user's folder, as fast as it can."""
    cache, precious = Cache(tmp_path / "cache"), tmp_path / "precious"
    folder = cache.obtain(KEY, build)[0].folder
    shutil.copytree(folder.parent, precious)
    (tmp_path / "link").symlink_to(precious)
    outside, group, end = held(precious), folder.parent, time.monotonic() + 1.5

    def swap():
        while time.monotonic() < end:
            group.rename(tmp_path / "away")
            (tmp_path / "link").rename(group)
            group.rename(tmp_path / "link")
            (tmp_path / "away").rename(group)

    swapping = multiprocessing.get_context("fork").Process(target=swap)
    swapping.start()
    removed = 0
    while swapping.is_alive():
        removed += cache.prune(0).entries
        shutil.copytree(precious / KEY, tmp_path / "new", dirs_exist_ok=True)
        with suppress(OSError):  # it is there still, or the group is away just now
            (tmp_path / "new").rename(folder)
    swapping.join()
    assert swapping.exitcode == 0 and held(precious) == outside and removed


# Two users -----------------------------------------------------------------------------------------------------------

def as_nobody(function, *arguments):
    """What `function` gives as another user without rights: its value, or the text of its error."""
    def child(end):
        nobody = pwd.getpwnam("nobody")
        os.setgroups([])
        os.setgid(nobody.pw_gid)
        os.setuid(nobody.pw_uid)
        try:
            end.send(function(*arguments))
        except XfemnavError as error:
            end.send(str(error))

    context = multiprocessing.get_context("fork")
    here, there = context.Pipe()
    process = context.Process(target=child, args=(there,))
    process.start()
    assert here.poll(30)
    process.join()
    return here.recv()


@pytest.fixture
def shared():
    """A folder in which everybody may write, below folders that everybody may enter."""
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        os.chmod(folder, 0o777)
        yield Path(folder)


def pruned(root):
    return Cache(root).prune(0)


needs_root = pytest.mark.skipif(os.getuid() != 0, reason="another user can only be become by root")


@needs_root
def test_the_cache_of_another_user_is_left_alone(shared):
    made(shared / "cache", "one", "two")
    before = held(shared)
    assert "E502" in as_nobody(pruned, shared / "cache") and held(shared) == before
    os.chmod(shared / "cache", 0o700)
    assert "E502" in as_nobody(pruned, shared / "cache")
    os.chmod(shared / "cache", 0o755)
    assert held(shared) == before


@needs_root
def test_in_a_cache_of_two_users_each_prunes_his_own(shared):
    """All folders of the cache are open to both, as with a common group; entries are of who has made them."""
    cache, (mine,) = made(shared / "cache", "mine")
    for path in (cache.root, *cache.root.rglob("*")):
        if path.is_dir() and path.name != mine.name and mine not in path.parents:
            os.chmod(path, 0o777)
    os.chmod(cache.root / "in-use", 0o666)
    theirs = as_nobody(lambda: Cache(cache.root).obtain(digest("theirs"), build)[0].folder)
    outside = held(mine)
    done = as_nobody(pruned, cache.root)
    assert done.entries == 1 and not theirs.exists() and held(mine) == outside
    assert done.kept == {mine.name: "Permission denied"}
    assert Cache(cache.root).prune(0).entries == 1 and not mine.exists()


@needs_root
def test_files_that_may_not_be_removed_are_kept_and_told(shared):
    def locked_up():
        cache, (folder, other) = made(shared / "cache", "one", "two")
        os.chmod(folder, 0o555)
        return folder, other, cache.prune(0)

    folder, other, done = as_nobody(locked_up)
    assert done.kept == {folder.name: "Permission denied"} and done.entries == 1
    assert folder.exists() and not other.exists()


# A cache in a study, and other folders that we clear -----------------------------------------------------------------

def test_a_cache_in_a_study(tmp_path, capfd):
    """`-w STUDY` is refused and the run says so; `-w STUDY/cache` takes nothing of the study with it."""
    study = tmp_path / "study"
    put(study, "locks/keys.txt", "damaged/scan.nii.gz", "participants.tsv")
    image, before = write(study / "head.nii.gz"), held(study)
    command = ("run", image, "--cut", CUT, *OPEN, *QUICK, "--stop-after", "segment", "-o", tmp_path / "out")
    assert xfemnav(capfd, *command, "-w", study)[0] == 73 and held(study) == before
    assert xfemnav(capfd, "cache", "prune", "--days", "0", "-w", study)[0] == 73 and held(study) == before
    assert xfemnav(capfd, *command, "-w", study / "cache")[0] == 0
    put(study, "cache/notes.txt")
    assert xfemnav(capfd, "cache", "prune", "--days", "0", "-w", study / "cache")[0] == 0
    after = held(study)
    assert {name: after.get(name) for name in before} == before and "cache/notes.txt" in after
    assert not any("facts.json" in name for name in after)


def test_an_empty_study_that_became_a_cache_keeps_what_comes_later(tmp_path):
    cache, _ = made(tmp_path, "one")
    put(tmp_path, "head.nii.gz", "entries/2024/scan.nii.gz", "locks/keys.txt", f"locks/{KEY}")
    before = tree(tmp_path)
    assert cache.prune(0).entries == 1
    assert all(tree(tmp_path)[name] == b"mine" for name, data in before.items() if data == b"mine")


def test_an_entry_is_not_written_through_a_link(tmp_path):
    """Nor is what lies there taken for a damaged entry and moved away."""
    cache, precious = Cache(tmp_path / "cache", lambda: Cache(tmp_path / "spare")), precious_in(tmp_path)
    (cache.root / "entries" / GROUP).symlink_to(precious)
    outside = held(precious)
    with pytest.warns(match="W602"):
        assert cache.obtain(KEY, build)[0].folder.is_relative_to(tmp_path / "spare")
    assert held(precious) == outside and cache.obtain(KEY, refuse)[1] == "cached"


def test_unfinished_files_of_others_stay_in_an_output_folder(tmp_path):
    put(tmp_path, ".notes.xfemnav-tmp", ".7-0.xfemnav-tmp", "x.xfemnav-tmp", ".draft.xfemnav-tmp/a")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / ".8-0.xfemnav-tmp").symlink_to(tmp_path / "elsewhere")
    before = held(tmp_path)
    remove_temporaries(tmp_path)
    assert before.keys() - held(tmp_path).keys() == {".7-0.xfemnav-tmp"}


def test_kernels_that_are_forgotten_take_nothing_with_them(tmp_path, monkeypatch):
    """NUMBA_CACHE_DIR may be any folder; of those like ours only what is kernels alone is removed."""
    own = [f"{kernels.NAME}{letter * 16}" for letter in "abc"]
    put(tmp_path, f"{own[0]}/geometry_1a/a.f-1.py311.nbi", f"{own[0]}/sealed", f"{own[1]}/thesis.txt",
        f"{own[1]}/geometry_1a/a.f-1.py311.nbi", f"{kernels.NAME}notes/a.nbi", "precious/a.nbi")
    (tmp_path / own[2]).symlink_to(tmp_path / "precious")
    for path in tmp_path.iterdir():
        os.utime(path, (0, 0), follow_symlinks=False)
    before = held(tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    kernels.settle_kernel_cache()
    gone = before.keys() - held(tmp_path).keys()
    assert gone and all(name.startswith(own[0]) for name in gone)


@pytest.mark.parametrize("sealed", [b'{"../../thesis.nbc": "0"}', b'{"/etc/x.nbc": "0"}', b"5", b"[]", b"[1]", b"{",
                                    b'{"a.nbc": 1}', b'{"thesis.txt": "0"}', b"[" * 100_000])
def test_a_forged_seal_of_kernels_leads_nowhere(tmp_path, monkeypatch, sealed):
    """Where it cannot be believed, kernels go; what else is there, and what it names elsewhere, stays."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "in"))
    kernels.settle_kernel_cache()
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    put(tmp_path, "thesis.nbc", "in/thesis.nbc")
    put(folder, "thesis.txt", "a.nbc", "geometry_1/b.nbi")
    (folder / "sealed").write_bytes(sealed)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "in"))
    kernels.settle_kernel_cache()
    left = {path for path in tmp_path.rglob("*") if path.is_file()}
    assert left == {tmp_path / "thesis.nbc", tmp_path / "in" / "thesis.nbc", folder / "thesis.txt"}


@needs_root
def test_damaged_kernels_that_cannot_be_removed_are_not_run(shared, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(shared))
    kernels.settle_kernel_cache()
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    put(folder, "geometry_1/a.nbc")
    os.chmod(folder, 0o777)
    (folder / "sealed").write_bytes(canonical({"geometry_1/a.nbc": digest("sound")}))

    def settled():
        os.environ["NUMBA_CACHE_DIR"] = str(shared)
        told = kernels.settle_kernel_cache()
        return told, os.environ["NUMBA_CACHE_DIR"]

    told, taken = as_nobody(settled)
    assert told == kernels.PASSING and not Path(taken).is_relative_to(shared)
