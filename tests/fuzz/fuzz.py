"""Coverage-guided fuzzing of what reads a user's files: python tests/fuzz/fuzz.py TARGET SECONDS [DIR]

Needs atheris. Inputs that found something new are kept in DIR (default out/fuzz/TARGET), and the next run begins with
them. The first uncaught exception, input that takes over 10 s, or memory over 1 GB ends the run with its input in
DIR/crash-*, timeout-* or oom-*. Exit status 0: nothing found.
"""

import sys
from pathlib import Path

import atheris

sys.path.insert(0, str(Path(__file__).parents[2]))
with atheris.instrument_imports(include=["xfemnav", "tomllib"]):
    from tests.fuzz.targets import READ, TARGETS, fed, seeds, words


def main(name: str, seconds: str, folder: str | None = None) -> None:
    """Feed one target for some seconds."""
    home = Path(folder or f"out/fuzz/{name}")
    corpus, dictionary = home / "corpus", home / "words.txt"
    corpus.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(seeds(name)):
        (corpus / f"seed-{number}").write_bytes(seed)
    listed = ['"' + "".join(f"\\x{byte:02x}" for byte in word.encode()) + '"\n' for word in words(name)]
    dictionary.write_text("".join(listed))
    arguments = [sys.argv[0], f"-max_total_time={int(seconds)}", f"-max_len={READ}", "-timeout=10",
                 "-rss_limit_mb=1024", "-print_final_stats=1", f"-artifact_prefix={home}/", str(corpus)]
    if listed:
        arguments.insert(-1, f"-dict={dictionary}")
    fed(name, seeds(name)[0])  # all that is imported, or made once, is: no input is blamed for its time
    atheris.Setup(arguments, lambda data: fed(name, data) and None)
    atheris.Fuzz()


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4) or sys.argv[1] not in TARGETS:
        sys.exit(__doc__)
    main(*sys.argv[1:])
