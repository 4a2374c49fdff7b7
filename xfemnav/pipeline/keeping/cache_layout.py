"""What a cache's folder holds, by its forms, and what in it is the cache's own: the rest is never touched.

    ROOT/CACHEDIR.TAG                       what the folder is, for programs that make backups and for us
    ROOT/entries/ab/abcd.../manifest.json   the key and the sha256 of every other file of the entry
    ROOT/locks/abcd...                      flock while the entry is made or checked
    ROOT/in-use                             shared flock while a run uses the cache, exclusive while it is pruned
    ROOT/damaged/                           entries that failed their check, set aside

`root`, `within`: descriptors of open folders, as in `removal`.
"""

import errno
import json
import os
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

from xfemnav.errors import XfemnavError
from xfemnav.pipeline.keeping.disk import TEMPORARY, UNFINISHED
from xfemnav.pipeline.keeping.names import NAMES, PAGES
from xfemnav.pipeline.keeping.removal import bytes_of, files, folders, open_folder, remove, stranger

MANIFEST = "manifest.json"
TAG, IN_USE = "CACHEDIR.TAG", "in-use"
# The first line is that of https://bford.info/cachedir, the second one says whose.
TAGGED = b"Signature: 8a477f597d28d172789f06886806bc55\n# A cache of xfemnav: all of it can be computed again.\n"
KEY = "([0-9a-f]{64})"
GROUP, ENTRY, ASIDE = map(re.compile, ("[0-9a-f]{2}", KEY, rf"{KEY}-\d+"))
LEFT = re.compile(rf"\.{KEY}(-replaced)?{re.escape(TEMPORARY)}")
HELD = re.compile(f"{ENTRY.pattern}|{LEFT.pattern}")
PARTS = ("entries", "locks", "damaged")
PART, OWN = re.compile("|".join(PARTS)), re.compile(rf"{IN_USE}|{re.escape(TAG)}|{UNFINISHED.pattern}")
# What a stage leaves in an entry.
ROLE = rf"({'|'.join((*NAMES, *PAGES))}|carry-\d+(-\w+)?)(\.\w+)+"
FILE = re.compile(rf"(manifest|facts|value)\.json|value\.npz|public/{ROLE}")


def held(root: int) -> Iterator[tuple[int, str]]:
    """All that a cache holds of entries, unfinished and damaged ones too: the open folder, and the name in it."""
    return ((within, name) for within, _, form in _levels(root) if form is not GROUP
            for name in folders(within, form))


def locks(within: int) -> list[str]:
    """Names of the locks in the open folder of them: files of nothing."""
    return [name for name in files(within, ENTRY) if not os.stat(name, dir_fd=within, follow_symlinks=False).st_size]


def remove_held(name: str, within: int) -> int:
    """Remove an entry from an open folder; its bytes. Raises OSError, also where it holds what is not the cache's."""
    ours = _made(name, within)
    other = stranger(name, within, ours)
    if other is not None:
        raise OSError(errno.ENOTEMPTY, f"it holds {other}, which is not the cache's")
    return remove(name, within, ours)


def refuse_foreign(path: Path, root: int) -> None:
    """Raise E504 unless the folder at `path`, open as `root`, is a cache of ours: one with our tag, or all in which has
    our forms; and no part of it is a link."""
    here = set(os.listdir(root))
    wrong = (here & set(PARTS)) - set(folders(root, PART))
    tagged = TAG in files(root, OWN) and bytes_of(TAG, root) == TAGGED
    if TAG in here and not tagged:
        wrong.add(TAG)
    other = min(wrong, default=None) or (None if tagged else next(_foreign(root, here), None))
    if other is not None:
        raise XfemnavError("E504", f"{path} is no cache of xfemnav: it holds {other}. Give an empty folder, or one "
                                   "that is not there yet, with ⟦cache⟧.")


def _foreign(root: int, here: set[str]) -> Iterator[str]:
    """What in a folder without a tag, which holds what is `here`, has none of our forms: names relative to it."""
    yield from sorted(here - set(PARTS) - set(files(root, OWN)))
    if "locks" in here:
        with open_folder("locks", root) as within:
            yield from (f"locks/{name}" for name in sorted(set(os.listdir(within)) - set(locks(within))))
    for within, place, form in _levels(root):
        known = folders(within, form)
        yield from (f"{place}/{name}" for name in sorted(set(os.listdir(within)) - set(known)))
        for name in known if form is not GROUP else ():
            other = stranger(name, within, _made(name, within))
            if other is not None:
                yield f"{place}/{name}/{other}"


def _levels(root: int) -> Iterator[tuple[int, str, re.Pattern]]:
    """The folders of a cache that hold folders: open, their places, and the form of the names in them."""
    gone = FileNotFoundError, NotADirectoryError  # or a link by now
    with suppress(*gone), open_folder("entries", root) as entries:
        yield entries, "entries", GROUP
        for group in folders(entries, GROUP):
            with suppress(*gone), open_folder(group, entries) as within:
                yield within, f"entries/{group}", HELD
    with suppress(*gone), open_folder("damaged", root) as damaged:
        yield damaged, "damaged", ASIDE


def _made(name: str, within: int) -> Callable[[str], bool]:
    """Whether a file of an entry is of the cache's making: one of its manifest's, or one that a stage leaves."""
    key, listed = re.search(KEY, name)[0], ()
    with suppress(OSError, ValueError, KeyError, TypeError, RecursionError), open_folder(name, within) as folder:
        manifest = json.loads(bytes_of(MANIFEST, folder))
        listed = tuple(manifest["files"]) if manifest["key"] == key else ()
    return lambda file: file in listed or bool(FILE.fullmatch(file))
