"""The page of error codes, `docs/reference/errors.md`, written from the table that the program itself uses.

    python -m xfemnav.pipeline.telling.errordocs > docs/reference/errors.md
"""

from xfemnav.errors import FAULTS, Fault
from xfemnav.naming import Names, flag, said

HEAD = """\
# Errors and warnings

Written by `make docs` from the table `FAULTS` in `xfemnav/errors.py`, which the program uses too; edit it there.

Every failure is one line: a code, what is wrong, where, and how to mend it. A traceback is printed only with `-vv`.
A command line that cannot be read (status 2) has no code: it is told with the usage of the command.
Warnings do not stop a run; they are printed, kept in `run.json` and shown in the report; ⟦strict⟧ makes them errors.

| exit status | meaning |
|--|--|
| 0 | done |
| 1 | some slices of a batch failed |
| 2 | the command line cannot be read |
| 3 | computed, but not to be trusted (the tissue is folded): files are written and marked `untrusted` |
| 65 | the data cannot be used |
| 66 | an input file is missing |
| 70 | a bug |
| 73, 74 | cannot write there; the disk is full |
| 75 | another run holds the output folder |
| 78 | the scenario or an option is not valid |
| 129, 130, 143 | ended by SIGHUP, SIGINT or SIGTERM; the same command resumes |
| 141 | whoever read standard output has gone away |
"""

GROUPS = {
    "E1": "Reading images", "E2": "Mask and mesh", "E3": "Cuts", "E4": "Mechanics", "E5": "Writing",
    "E7": "Scenarios and other files", "E8": "Memory", "E9": "Bugs", "W": "Warnings",
}


def _in_docs(name: str, value: str) -> str:
    return f"`{flag(name, value)}`"


#: How the pages call settings: as the command line does.
IN_DOCS = Names(_in_docs, _in_docs, "", "")


def page() -> str:
    """The whole page, Markdown: a table of contents by group, then one section a code."""
    groups = {title: [code for code in FAULTS if code.startswith(start)] for start, title in GROUPS.items()}
    lines = [said(HEAD, IN_DOCS)]
    for title, codes in groups.items():
        lines.append(f"**{title}**: " + " ".join(f"[{code}](#{code.lower()})" for code in codes) + "\n")
    for title, codes in groups.items():
        lines.append(f"## {title}\n")
        lines += [section(code, FAULTS[code]) for code in codes]
    return "\n".join(lines)


def section(code: str, fault: Fault) -> str:
    """One code: its title, when it happens, what to do."""
    status = f" Exit status {fault.exit_code}." if code.startswith("E") else ""
    return said(f"### {code}\n\n**{fault.title}.** {fault.cause}{status}\n\nWhat to do: {fault.remedy}\n", IN_DOCS)


if __name__ == "__main__":
    print(page(), end="")
