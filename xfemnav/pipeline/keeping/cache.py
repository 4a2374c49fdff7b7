"""Results on disk under their content key: written whole or not at all, verified on every read, healed when damaged.

A manifest counts only if it is, byte for byte, the canonical JSON of what it says, so that a flipped bit anywhere in
an entry is noticed. That is also why no entry is forced onto the disk: what a power cut tears is made anew.

Nothing is ever removed but what the cache has made: files and folders whose names have the forms of `cache_layout`, in
a folder that bears the tag, none of them reached through a link. What else there is stays, and so does the entry that
holds it.
"""

import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from xfemnav.errors import XfemnavError, warn
from xfemnav.pipeline.keeping.cache_layout import (
    ENTRY,
    IN_USE,
    LEFT,
    MANIFEST,
    PARTS,
    TAG,
    TAGGED,
    held,
    locks,
    refuse_foreign,
    remove_held,
)
from xfemnav.pipeline.keeping.disk import TEMPORARY, write_atomic, writing
from xfemnav.pipeline.keeping.keys import canonical, digest, file_digest
from xfemnav.pipeline.keeping.locks import locked
from xfemnav.pipeline.keeping.removal import folders, open_folder


@dataclass(frozen=True)
class Entry:
    """A verified entry: its key, its folder, and the sha256 of each of its files by name relative to the folder."""

    key: str
    folder: Path
    files: dict[str, str]

    def content(self, *names: str) -> str:
        """Digest of the content of the files `names`."""
        return digest({name: self.files[name] for name in names})


class Pruned(NamedTuple):
    """How many entries were removed, the bytes freed, and what was to go and is still there: why, by its name."""

    entries: int
    freed: int
    kept: dict[str, str]


class Cache:
    """A folder of entries that several processes share.

    `spare` makes the cache that takes over where an entry of another user's cannot be written (None: E502).
    """

    def __init__(self, root: Path, spare: "Callable[[], Cache] | None" = None):
        """Make the folder, or take it over. Raises XfemnavError E504 when it is somebody's own, E501, E502."""
        self.root, self._spare = Path(root), spare
        with writing(self.root, "the cache"):
            self.root.mkdir(parents=True, exist_ok=True)
            with self._open() as root:
                refuse_foreign(self.root, root)
            if not os.path.exists(self.root / TAG):
                write_atomic(self.root / TAG, TAGGED)
            for part in PARTS:
                (self.root / part).mkdir(exist_ok=True)
            with locked(self.root / IN_USE, shared=True):
                pass

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Keep `prune` away while a run relies on entries that it has verified."""
        with locked(self.root / IN_USE, shared=True):
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
            warn("W602", f"the cache folder {self.root} cannot be written ({error.text.split(': ')[-1]}); what is "
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
        with writing(self.root, "the cache"), self._open() as root:
            return sorted(name for _, name in held(root) if ENTRY.fullmatch(name))

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

    def prune(self, older_than_s: float) -> Pruned:
        """Remove entries unused for `older_than_s` seconds, and all debris.

        What holds something that is not the cache's, and what the system refuses to remove, is kept. Raises
        XfemnavError E503 while a run uses the cache, E504 when it is none any more.
        """
        count, freed, kept, before = 0, 0, {}, time.time() - older_than_s
        with locked(self.root / IN_USE, limit_s=2.0), writing(self.root, "the cache"), self._open() as root:
            refuse_foreign(self.root, root)
            for within, name in held(root):
                is_entry = bool(ENTRY.fullmatch(name))
                try:
                    if not is_entry or os.stat(name, dir_fd=within, follow_symlinks=False).st_mtime <= before:
                        freed += remove_held(name, within)
                        count += is_entry
                except OSError as error:
                    kept[name] = error.strerror
            with open_folder("locks", root) as within, suppress(PermissionError):  # another user's
                for name in locks(within):
                    os.unlink(name, dir_fd=within)
        return Pruned(count, freed, kept)

    @contextmanager
    def _open(self, *names: str) -> Iterator[int]:
        """A descriptor of the cache's folder, or of one below it: of `names` none may be a link."""
        with ExitStack() as stack:
            handle = stack.enter_context(open_folder(self.root, linked=True))
            for name in names:
                handle = stack.enter_context(open_folder(name, handle))
            yield handle

    def _folder(self, key: str) -> Path:
        return self.root / "entries" / key[:2] / key

    def _write(self, key: str, build: Callable[[Path], None]) -> Entry:
        folder = self._folder(key)
        temporary, replaced = (folder.with_name(f".{key}{part}{TEMPORARY}") for part in ("", "-replaced"))
        with writing(self.root, "the cache"):
            folder.parent.mkdir(exist_ok=True)
            with self._open("entries", key[:2]) as group:
                for left in folders(group, LEFT):
                    if key in left:  # a killed run's; we hold the key's lock
                        remove_held(left, group)
            temporary.mkdir()
            try:
                build(temporary)
                files = _digests(temporary)
                (temporary / MANIFEST).write_bytes(canonical({"key": key, "files": files}))
                if folder.exists():  # made anew by force
                    os.rename(folder, replaced)
                os.rename(temporary, folder)
                self._forget(replaced)
            except BaseException:
                self._forget(temporary)
                raise
        return Entry(key, folder, files)

    def _forget(self, folder: Path) -> None:
        """Remove a folder of our own making, if it is there and can be removed."""
        with suppress(OSError), self._open("entries", folder.parent.name) as group:
            remove_held(folder.name, group)

    def _set_aside(self, key: str) -> None:
        """Move an entry out of the way under a name that nothing else has."""
        with (writing(self.root, "the cache"), self._open("entries", key[:2]) as group,
              self._open("damaged") as damaged):
            taken, number = set(os.listdir(damaged)), 0
            while (aside := f"{key}-{number}") in taken:
                number += 1
            os.rename(key, aside, src_dir_fd=group, dst_dir_fd=damaged)


def _digests(folder: Path) -> dict[str, str]:
    """sha256 of every file below `folder` but the manifest, by relative name. Raises ValueError for links."""
    files = [path for path in folder.rglob("*") if not path.is_dir() and path.name != MANIFEST]
    if folder.is_symlink() or any(map(Path.is_symlink, files)):
        raise ValueError("a link in the cache")
    return {path.relative_to(folder).as_posix(): file_digest(path) for path in files}


def _bytes_under(folder: Path) -> int:
    return sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file())
