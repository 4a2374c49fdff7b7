"""The cache on toy entries: hits, misses, healing, concurrency and death at any moment."""

import os
import random
import signal
import time
import warnings

import pytest

from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.pipeline.keeping import disk, keys
from xfemnav.pipeline.keeping.cache import TAG, TAGGED, Cache
from xfemnav.pipeline.keeping.keys import PACKAGE, canonical, code_digest, digest
from xfemnav.pipeline.stages.table import CARRY, FIGURE, SAFE, STAGES

KEY = digest("toy")
PAYLOAD = bytes(range(256)) * 8


def build(folder):
    (folder / "public").mkdir()
    (folder / "value.npz").write_bytes(PAYLOAD)
    (folder / "public" / "mask.nii.gz").write_bytes(PAYLOAD[::-1])


def refuse(folder):
    raise AssertionError("computed again")


def read(entry):
    return (entry.folder / "value.npz").read_bytes(), (entry.folder / "public" / "mask.nii.gz").read_bytes()


def test_second_time_is_cached_and_never_computed(tmp_path):
    entry, status = Cache(tmp_path).obtain(KEY, build)
    again, cached = Cache(tmp_path).obtain(KEY, refuse)
    assert (status, cached) == ("ran", "cached")
    assert read(entry) == read(again) == (PAYLOAD, PAYLOAD[::-1])
    assert entry.content("value.npz") == again.content("value.npz")


def test_force_computes_again(tmp_path):
    cache = Cache(tmp_path)
    cache.obtain(KEY, build)
    assert cache.obtain(KEY, build, force=True)[1] == "ran"
    with pytest.raises(AssertionError):
        cache.obtain(KEY, refuse, force=True)
    assert cache.obtain(KEY, refuse)[1] == "cached"  # the failed attempt left the good entry alone
    assert not list((tmp_path / "damaged").iterdir())  # what was replaced was not damaged
    assert not list((tmp_path / "entries").glob("*/.*"))


def test_what_was_used_of_late_is_not_pruned(tmp_path):
    cache = Cache(tmp_path)
    used, left = (cache.obtain(digest(n), build)[0] for n in range(2))
    for entry in (used, left):
        os.utime(entry.folder, (0, 0))
    cache.obtain(used.key, refuse)
    assert cache.prune(older_than_s=3600).entries == 1 and cache.keys() == [used.key]


def test_every_bit_flip_heals(tmp_path):
    """200 random single-bit flips over all bytes of an entry, its manifest too: found, set aside, made anew (W601)."""
    rng, cache = random.Random(0), Cache(tmp_path)
    entry, _ = cache.obtain(KEY, build)
    files = sorted(path for path in entry.folder.rglob("*") if path.is_file())
    for _ in range(200):
        path = rng.choice(files)
        data = bytearray(path.read_bytes())
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(data)
        with pytest.warns(XfemnavWarning, match="W601"):
            healed, status = cache.obtain(KEY, build)
        assert status == "healed" and read(healed) == (PAYLOAD, PAYLOAD[::-1])
    assert len(list((tmp_path / "damaged").iterdir())) == 200


@pytest.mark.parametrize("harm", ["truncate", "remove", "add", "no manifest", "empty manifest"])
def test_other_damage_heals(tmp_path, harm):
    cache = Cache(tmp_path)
    folder = cache.obtain(KEY, build)[0].folder
    match harm:
        case "truncate":
            os.truncate(folder / "value.npz", 100)
        case "remove":
            (folder / "value.npz").unlink()
        case "add":
            (folder / "stranger").write_text("x")
        case "no manifest":
            (folder / "manifest.json").unlink()
        case "empty manifest":
            (folder / "manifest.json").write_text("")
    with pytest.warns(XfemnavWarning, match="W601"):
        assert cache.obtain(KEY, build)[1] == "healed"


def test_entry_moved_under_another_key_is_not_believed(tmp_path):
    """Row 47: the key is in the manifest, so that a swapped or rolled-back entry heals."""
    cache, other = Cache(tmp_path), digest("other")
    folder = cache.obtain(KEY, build)[0].folder
    target = cache.root / "entries" / other[:2] / other
    target.parent.mkdir(exist_ok=True)
    folder.rename(target)
    with pytest.warns(XfemnavWarning, match="W601"):
        assert cache.obtain(other, build)[1] == "healed"


def test_verify_sets_damaged_entries_aside_and_prune_empties(tmp_path):
    cache = Cache(tmp_path)
    (cache.obtain(KEY, build)[0].folder / "value.npz").write_bytes(b"?")
    good = cache.obtain(digest("good"), build)[0]
    assert cache.set_aside_damaged() == [KEY] and cache.keys() == [good.key]
    assert cache.prune(older_than_s=3600).entries == 0 and cache.keys() == [good.key]
    assert cache.prune(older_than_s=0).entries == 1 and cache.keys() == []


def test_prune_waits_for_no_running_run(tmp_path, monkeypatch):
    cache = Cache(tmp_path)
    with cache.in_use(), pytest.raises(XfemnavError, match="E503"):
        Cache(tmp_path).prune(0)


def tree(root):
    return {path.relative_to(root).as_posix(): path.is_file() and path.read_bytes() for path in sorted(root.rglob("*"))}


@pytest.mark.parametrize("name", ["damaged/thesis.txt", "locks/keys.txt", "entries/2024/scan.nii.gz", "notes.txt",
                                  "entries/ab.txt", TAG])
def test_a_folder_of_the_users_own_is_refused_and_keeps_everything(tmp_path, name):
    """A study that happens to have folders of our names, or another program's cache, is no cache of ours."""
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text("Signature: 8a477f597d28d172789f06886806bc55\n# of another program\n")
    before = tree(tmp_path)
    with pytest.raises(XfemnavError, match=r"E504.*no cache of xfemnav"):
        Cache(tmp_path)
    assert tree(tmp_path) == before


@pytest.mark.parametrize("part", ["entries", "locks", "damaged"])
def test_a_part_that_is_a_link_is_refused(tmp_path, part):
    precious = tmp_path / "precious"
    (precious / "ab" / KEY).mkdir(parents=True)
    (precious / KEY).write_text("mine")
    before = tree(precious)
    for root in (tmp_path / "new", tmp_path / "tagged"):
        root.mkdir()
        if root.name == "tagged":
            (root / TAG).write_bytes(TAGGED)
        (root / part).symlink_to(precious)
        with pytest.raises(XfemnavError, match=f"E504.*{part}"):
            Cache(root)
    assert tree(precious) == before


def test_prune_takes_what_the_cache_has_made_and_nothing_else(tmp_path):
    """Files of the user's in a cache, and whatever links lead to, stay."""
    precious, cache = tmp_path / "precious", Cache(tmp_path / "cache")
    for folder in (precious, precious / KEY):
        folder.mkdir()
        (folder / "mine.txt").write_text("mine")
    entry = cache.obtain(digest("old"), build)[0].folder
    root, other = cache.root, digest("linked")
    for own in ("mine.txt", "entries/mine.txt", "damaged/mine.txt", "locks/mine.txt", f"entries/{KEY[:2]}/mine"):
        (root / own).parent.mkdir(exist_ok=True)
        (root / own).write_text("mine")
    (root / "damaged" / "mine").mkdir()
    (root / "entries" / "mine").mkdir()
    for link in (f"entries/{other[:2]}/{other}", f"damaged/{KEY}-0", f"locks/{KEY}"):
        (root / link).parent.mkdir(exist_ok=True)
        (root / link).symlink_to(precious / KEY)
    (root / "entries" / "ff").symlink_to(precious)
    kept, made = tree(precious), {path for path in tree(root)}
    (root / "damaged" / f"{KEY}-1").mkdir()
    (root / "entries" / entry.parent.name / f".{KEY}.xfemnav-tmp").mkdir()
    count, freed, kept_in = Cache(root).prune(0)
    assert count == 1 and freed > len(PAYLOAD) and not kept_in and not entry.exists() and tree(precious) == kept
    gone = made - set(tree(root))
    assert gone and all(digest("old") in name for name in gone)


def test_a_cache_of_before_is_marked_and_goes_on(tmp_path):
    cache = Cache(tmp_path)
    cache.obtain(KEY, build)
    (tmp_path / TAG).unlink()
    assert Cache(tmp_path).obtain(KEY, refuse)[1] == "cached"
    assert (tmp_path / TAG).read_bytes() == TAGGED


@pytest.mark.parametrize("call, part", [("open", "locks"), ("mkdir", "entries"), ("rename", "entries")])
def test_an_entry_that_cannot_be_written_goes_to_the_spare_cache(tmp_path, monkeypatch, call, part):
    """A cache of two users: the locks and folders of the one are closed to the other."""
    real = getattr(os, call)

    def closed(path, *rest, **named):
        if str(tmp_path / "shared" / part) in str(path):
            raise PermissionError(13, "Permission denied")
        return real(path, *rest, **named)

    cache = Cache(tmp_path / "shared", lambda: Cache(tmp_path / "spare"))
    monkeypatch.setattr(os, call, closed)
    with pytest.warns(XfemnavWarning, match="W602.*Permission denied") as told:
        entries = [cache.obtain(digest(n), build)[0] for n in range(3)]
    assert len(told) == 1 and all(entry.folder.is_relative_to(tmp_path / "spare") for entry in entries)
    with pytest.raises(XfemnavError, match="E502"):
        Cache(tmp_path / "shared").obtain(KEY, build)


@pytest.mark.parametrize("number, wanted", [(12, MemoryError), (28, XfemnavError), (5, XfemnavError)])
def test_a_refusal_is_told_as_what_it_is(tmp_path, number, wanted):
    def build_refused(folder):
        raise OSError(number, os.strerror(number))

    with pytest.raises(wanted, match={12: "allocate", 28: "E501", 5: "E502.*Input/output"}[number]):
        Cache(tmp_path).obtain(KEY, build_refused)


def test_an_error_without_a_number_keeps_its_words(tmp_path):
    with pytest.raises(XfemnavError, match=r"E502.*no reason given by the system"), disk.writing(tmp_path, "a file"):
        raise OSError("no reason given by the system")


def test_root_that_cannot_be_made_is_refused_with_its_code(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(XfemnavError, match="E502"):
        Cache(tmp_path / "file" / "cache")


def test_full_disk_leaves_nothing_behind(tmp_path):
    """Row 40, with the kernel's own ENOSPC from /dev/full."""
    cache = Cache(tmp_path)

    def build_on_full_disk(folder):
        (folder / "value.npz").write_bytes(PAYLOAD)
        with open("/dev/full", "wb", buffering=0) as full:
            full.write(b"x")

    with pytest.raises(XfemnavError, match="E501"):
        cache.obtain(KEY, build_on_full_disk)
    assert not [path for path in (tmp_path / "entries").rglob("*") if path.is_file()]
    assert cache.obtain(KEY, build)[1] == "ran"


def write_forty(root):
    """What each of the two concurrent writers does: 40 entries of 8 files."""
    def build_parts(folder):
        (folder / "public").mkdir()
        for i in range(8):
            (folder / "public" / f"carry-{i}.csv").write_bytes(PAYLOAD * (i + 1))

    cache = Cache(root)
    return [cache.obtain(digest(n), build_parts)[1] for n in range(40)]


def in_child(function, *arguments):
    """Process id of a fork that runs `function` and leaves without the parent's clean-up."""
    child = os.fork()
    if child == 0:
        function(*arguments)
        os._exit(0)
    return child


def chaos(tmp_path, kills):
    """Kill two concurrent writers at random moments, `kills` times; nothing that they leave may be wrong."""
    rng = random.Random(1)
    for n in range(kills // 2):
        root = tmp_path / str(n % 4)
        for child in [in_child(write_forty, root) for _ in range(2)]:
            time.sleep(rng.uniform(0, 0.05))
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
        assert Cache(root).set_aside_damaged() == []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for n in range(4):
            assert len(write_forty(tmp_path / str(n))) == len(Cache(tmp_path / str(n)).keys()) == 40


def test_kill_at_any_moment_leaves_no_wrong_entry(tmp_path):
    chaos(tmp_path, 20)


@pytest.mark.slow
def test_kill_at_any_moment_leaves_no_wrong_entry_200_times(tmp_path):
    chaos(tmp_path, 200)


def test_canonical_json_has_one_text_for_equal_values():
    assert canonical({"b": (1, 2.5), "a": None}) == canonical({"a": None, "b": [1, 2.5]}) == b'{"a":null,"b":[1,2.5]}'
    with pytest.raises(ValueError):
        canonical(float("nan"))


def test_edited_code_changes_the_keys_of_the_layers_above_it(tmp_path):
    """Row 48: a helper in mechanics concerns mechanics and what builds on it, not imaging."""
    for source in (path for path in PACKAGE.rglob("*") if path.suffix in (".py", ".html", ".json")):
        target = tmp_path / source.relative_to(PACKAGE)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(source.read_bytes())
    layers = ("geometry", "imaging", "mechanics", "pipeline")
    before = {layer: code_digest((layer,), tmp_path) for layer in layers}
    for edited, expected in (("mechanics/__init__.py", ["mechanics", "pipeline"]),
                             ("pipeline/telling/report.html", ["pipeline"]),
                             ("pipeline/running/run.schema.json", ["pipeline"])):
        (tmp_path / edited).write_text("# edited\n")
        code_digest.cache_clear()
        after = {layer: code_digest((layer,), tmp_path) for layer in layers}
        assert [layer for layer in layers if before[layer] != after[layer]] == expected
        before = after


@pytest.mark.parametrize("stage", [*STAGES.values(), CARRY, FIGURE, SAFE], ids=lambda stage: stage.name)
def test_another_version_of_a_library_is_another_key(stage, monkeypatch):
    def key():
        return keys.stage_key(stage.name, stage.layers, stage.libraries, {}, {})

    before, real = key(), keys._installed
    for library in stage.libraries:
        monkeypatch.setattr(keys, "_installed", lambda name, new=library: "999" if name == new else real(name))
        assert key() != before, library
    monkeypatch.setattr(keys, "_installed", real)
    assert key() == before and {"numpy", "scipy", "numba"} <= set(stage.libraries)


def test_all_that_a_result_depends_on_is_in_its_key(monkeypatch):
    def key(**other):
        given = {"stage": "mesh", "layers": ("geometry",), "libraries": ("numpy",), "params": 1, "inputs": {"mask": 1}}
        return keys.stage_key(**given | other)

    found = [key(), key(stage="warp"), key(layers=("imaging",)), key(params=2), key(inputs={"mask": 2})]
    for code in ("own_digest", "code_digest"):
        monkeypatch.setattr(keys, code, lambda edited: "edited")
        found.append(key())
    assert len(set(found)) == len(found)
