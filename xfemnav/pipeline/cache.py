"""Results on disk under their content key: written whole or not at all, verified on every read, healed when damaged.

    ROOT/CACHEDIR.TAG                       what the folder is, for programs that make backups and for us
    ROOT/entries/ab/abcd.../manifest.json   the key and the sha256 of every other file of the entry
    ROOT/locks/abcd...                      flock while the entry is made or checked
    ROOT/in-use                             shared flock while a run uses the cache, exclusive while it is pruned
    ROOT/damaged/                           entries that failed their check, set aside

A manifest counts only if it is, byte for byte, the canonical JSON of what it says, so that a flipped bit anywhere in
an entry is noticed. That is also why no entry is forced onto the disk: what a power cut tears is made anew.

Nothing is ever removed but what the cache has made: files and folders whose names have the forms above, in a folder
that bears the tag, none of them reached through a link.
"""

import json
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from xfemnav.errors import XfemnavError, warn
from xfemnav.pipeline.disk import TEMPORARY, write_atomic, writing
from xfemnav.pipeline.keys import canonical, digest, file_digest
from xfemnav.pipeline.locks import locked

MANIFEST = "manifest.json"
TAG = "CACHEDIR.TAG"
# The first line is that of https://bford.info/cachedir, the second one says whose.
TAGGED = b"Signature: 8a477f597d28d172789f06886806bc55\n# A cache of xfemnav: all of it can be computed again.\n"
HEX = "[0-9a-f]"
GROUP, ENTRY, ASIDE = map(re.compile, (f"{HEX}{{2}}", f"{HEX}{{64}}", rf"{HEX}{{64}}-\d+"))
LEFT = re.compile(rf"\.{HEX}{{64}}(-replaced)?{re.escape(TEMPORARY)}")
PARTS = {"entries": GROUP, "locks": ENTRY, "damaged": ASIDE}  # and the forms of the names in them
OURS = re.compile(rf"{'|'.join(PARTS)}|in-use|{re.escape(TAG)}|\.\d+-\d+{re.escape(TEMPORARY)}")


@dataclass(frozen=True)
class Entry:
    """A verified entry: its key, its folder, and the sha256 of each of its files by name relative to the folder."""

    key: str
    folder: Path
    files: dict[str, str]

    def content(self, *names: str) -> str:
        """Digest of the content of the files `names`."""
        return digest({name: self.files[name] for name in names})


class Cache:
    """A folder of entries that several processes share.

    `spare` makes the cache that takes over where an entry of another user's cannot be written (None: E502).
    """

    def __init__(self, root: Path, spare: "Callable[[], Cache] | None" = None):
        """Make the folder, or take it over. Raises XfemnavError E504 when it is somebody's own, E501, E502."""
        self.root, self._spare = Path(root), spare
        with writing(self.root, "the cache"):
            self.root.mkdir(parents=True, exist_ok=True)
            _refuse_foreign(self.root)
            if not (self.root / TAG).exists():
                write_atomic(self.root / TAG, TAGGED)
            for part in PARTS:
                (self.root / part).mkdir(exist_ok=True)
            with locked(self.root / "in-use", shared=True):
                pass

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Keep `prune` away while a run relies on entries that it has verified."""
        with locked(self.root / "in-use", shared=True):
            yield

    def obtain(self, key: str, build: Callable[[Path], None], *, force: bool = False) -> tuple[Entry, str]:
        """The entry of `key` and how it came: 'cached', 'ran' or 'healed' (W601: it was damaged and was made anew).

        `build` writes the entry's files into the empty folder that it gets. When it raises, nothing is stored. Where
        this cache cannot be written, the spare one is, with W602.
        """
        try:
            return self._obtain(key, build, force)
        except XfemnavError as error:
            if error.code != "E502" or self._spare is None:
                raise
            warn("W602", f"the cache folder {self.root} cannot be written ({error.message.split(': ')[-1]}); what is "
                         "computed is not kept for the next run.")
        self._obtain = self._spare()._obtain
        return self._obtain(key, build, force)

    def _obtain(self, key: str, build: Callable[[Path], None], force: bool) -> tuple[Entry, str]:
        with locked(self.root / "locks" / key):
            status = "ran"
            if not force:
                entry = self.verified(key)
                if entry is not None:
                    with suppress(OSError):  # when it was last used, which is for the owner to keep
                        os.utime(entry.folder)
                    return entry, "cached"
                if self._folder(key).exists():
                    self._set_aside(key)
                    warn("W601", f"cache entry {key[:12]} was damaged; it was set aside in {self.root / 'damaged'} "
                                 "and computed again.")
                    status = "healed"
            return self._write(key, build), status

    def verified(self, key: str) -> Entry | None:
        """The entry of `key` if it is there and every byte of it is as written, else None."""
        folder = self._folder(key)
        try:
            raw = (folder / MANIFEST).read_bytes()
            manifest = json.loads(raw)
            if raw != canonical(manifest) or manifest["key"] != key or manifest["files"] != _digests(folder):
                return None
            return Entry(key, folder, manifest["files"])
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def keys(self) -> list[str]:
        """All keys with an entry, damaged ones too, sorted."""
        return sorted(path.name for path in self._within_groups(ENTRY))

    def size(self, key: str) -> int:
        """Bytes of an entry on disk."""
        return _bytes_under(self._folder(key))

    def set_aside_damaged(self) -> list[str]:
        """Check every entry, set the damaged ones aside, and return their keys."""
        damaged = []
        for key in self.keys():
            with locked(self.root / "locks" / key):
                if self.verified(key) is None:
                    self._set_aside(key)
                    damaged.append(key)
        return damaged

    def prune(self, older_than_s: float) -> tuple[int, int]:
        """Remove entries unused for `older_than_s` seconds, and all debris; the count and bytes removed.

        Raises XfemnavError E503 while a run uses the cache.
        """
        with locked(self.root / "in-use", limit_s=2.0):
            old = [key for key in self.keys() if time.time() - self._folder(key).stat().st_mtime >= older_than_s]
            debris = [*_folders(self.root / "damaged", ASIDE), *self._within_groups(LEFT)]
            gone, freed = [*map(self._folder, old), *debris], 0
            with writing(self.root, "the cache"):
                for folder in gone:
                    freed += _bytes_under(folder)
                    shutil.rmtree(folder)
                for lock in (self.root / "locks").iterdir():
                    if ENTRY.fullmatch(lock.name) and lock.is_file() and not lock.is_symlink():
                        lock.unlink()
            return len(old), freed

    def _within_groups(self, form: re.Pattern) -> list[Path]:
        """Folders whose names have a `form`, in the folders of entries."""
        return [path for group in _folders(self.root / "entries", GROUP) for path in _folders(group, form)]

    def _folder(self, key: str) -> Path:
        return self.root / "entries" / key[:2] / key

    def _write(self, key: str, build: Callable[[Path], None]) -> Entry:
        folder = self._folder(key)
        temporary, replaced = (folder.with_name(f".{key}{part}{TEMPORARY}") for part in ("", "-replaced"))
        with writing(self.root, "the cache"):
            for left in filter(Path.exists, (temporary, replaced)):  # a killed run's; we hold the key's lock
                shutil.rmtree(left)
            temporary.mkdir(parents=True)
            try:
                build(temporary)
                files = _digests(temporary)
                (temporary / MANIFEST).write_bytes(canonical({"key": key, "files": files}))
                if folder.exists():  # made anew by force
                    os.rename(folder, replaced)
                os.rename(temporary, folder)
                shutil.rmtree(replaced, ignore_errors=True)
            except BaseException:
                shutil.rmtree(temporary, ignore_errors=True)
                raise
        return Entry(key, folder, files)

    def _set_aside(self, key: str) -> None:
        """Move an entry out of the way under a name that nothing else has."""
        number = 0
        while (aside := self.root / "damaged" / f"{key}-{number}").exists():
            number += 1
        with writing(self.root, "the cache"):
            os.rename(self._folder(key), aside)


def _folders(parent: Path, form: re.Pattern) -> list[Path]:
    """The folders in `parent` whose names have a `form`; a link is none."""
    with os.scandir(parent) as found:
        return [Path(item) for item in found if form.fullmatch(item.name) and item.is_dir(follow_symlinks=False)]


def _refuse_foreign(root: Path) -> None:
    """Raise E504 unless a folder is a cache of ours: tagged, or with names of our forms alone; and no part a link."""
    tag, parts = root / TAG, map(root.joinpath, PARTS)
    tagged = tag.is_file() and tag.read_bytes()
    wrong = [part for part in parts if part.is_symlink() or part.is_file()] + [tag] * (tagged not in (TAGGED, False))
    stranger = next(iter(wrong), None)
    if stranger is None and not tagged:
        forms = {root: OURS} | {root / part: form for part, form in PARTS.items()}
        stranger = next((path for folder, form in forms.items() if folder.is_dir()
                         for path in sorted(folder.iterdir()) if not form.fullmatch(path.name)), None)
    if stranger is not None:
        raise XfemnavError("E504", f"{root} is no cache of xfemnav: it holds {stranger.relative_to(root)}. Give an "
                                   "empty folder, or one that is not there yet, with -w.")


def _digests(folder: Path) -> dict[str, str]:
    """sha256 of every file below `folder` but the manifest, by relative name. Raises ValueError for links."""
    files = [path for path in folder.rglob("*") if not path.is_dir() and path.name != MANIFEST]
    if folder.is_symlink() or any(map(Path.is_symlink, files)):
        raise ValueError("a link in the cache")
    return {path.relative_to(folder).as_posix(): file_digest(path) for path in files}


def _bytes_under(folder: Path) -> int:
    return sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file())
