"""Results on disk under their content key: written whole or not at all, verified on every read, healed when damaged.

    ROOT/entries/ab/abcd.../manifest.json   the key and the sha256 of every other file of the entry
    ROOT/locks/abcd...                      flock while the entry is made or checked
    ROOT/in-use                             shared flock while a run uses the cache, exclusive while it is pruned
    ROOT/damaged/                           entries that failed their check, set aside

A manifest counts only if it is, byte for byte, the canonical JSON of what it says, so that a flipped bit anywhere in
an entry is noticed. That is also why no entry is forced onto the disk: what a power cut tears is made anew.
"""

import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from xfemnav.errors import warn
from xfemnav.pipeline.disk import TEMPORARY, writing
from xfemnav.pipeline.keys import canonical, digest, file_digest
from xfemnav.pipeline.locks import locked

MANIFEST = "manifest.json"


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
    """A folder of entries that several processes share."""

    def __init__(self, root: Path):
        """Make the folder. Raises XfemnavError E502 or E501 when it cannot be written."""
        self.root = Path(root)
        with writing(self.root, "the cache"):
            for part in ("entries", "locks", "damaged"):
                (self.root / part).mkdir(parents=True, exist_ok=True)
            with locked(self.root / "in-use", shared=True):
                pass

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Keep `prune` away while a run relies on entries that it has verified."""
        with locked(self.root / "in-use", shared=True):
            yield

    def obtain(self, key: str, build: Callable[[Path], None], *, force: bool = False) -> tuple[Entry, str]:
        """The entry of `key` and how it came: 'cached', 'ran' or 'healed' (W601: it was damaged and was made anew).

        `build` writes the entry's files into the empty folder that it gets. When it raises, nothing is stored.
        """
        with locked(self.root / "locks" / key):
            status = "ran"
            if not force:
                entry = self.verified(key)
                if entry is not None:
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
        return sorted(path.name for path in (self.root / "entries").glob("??/*") if not path.name.startswith("."))

    def size(self, key: str) -> int:
        """Bytes of an entry on disk."""
        return sum(path.stat().st_size for path in self._folder(key).rglob("*") if path.is_file())

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
            before = _bytes_under(self.root)
            shutil.rmtree(self.root / "damaged")
            (self.root / "damaged").mkdir()
            for left in (*(self.root / "entries").glob(f"??/.*{TEMPORARY}"), *(self.root / "locks").iterdir()):
                shutil.rmtree(left) if left.is_dir() else left.unlink()
            old = [key for key in self.keys() if time.time() - self._folder(key).stat().st_mtime >= older_than_s]
            for key in old:
                shutil.rmtree(self._folder(key))
            return len(old), before - _bytes_under(self.root)

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
        os.rename(self._folder(key), aside)


def _digests(folder: Path) -> dict[str, str]:
    """sha256 of every file below `folder` but the manifest, by relative name."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != MANIFEST)
    return {path.relative_to(folder).as_posix(): file_digest(path) for path in files}


def _bytes_under(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
