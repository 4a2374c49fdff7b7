"""`xfemnav check`, `schema` and `cache`."""

import json
from pathlib import Path

import click

from xfemnav.errors import EXIT_CONFIG, EXIT_DATA

FILE = click.Path(path_type=Path)


@click.command()
@click.argument("scenario", type=FILE)
def check(scenario):
    """List every problem of a SCENARIO file, without running it."""
    from xfemnav.pipeline.config import scenario_problems

    found = scenario_problems(scenario)
    for line in found:
        click.echo(line)
    if not found:
        click.echo(f"{scenario}: no problem found")
    return EXIT_CONFIG if found else 0


@click.command()
@click.argument("which", type=click.Choice(["scenario", "run"]), default="scenario")
def schema(which):
    """Print the JSON Schema of a scenario, or of run.json (`xfemnav schema run`)."""
    if which == "run":
        from xfemnav.pipeline.runfile import run_schema

        found = run_schema()
    else:
        from xfemnav.pipeline.scenario import Scenario

        found = Scenario.model_json_schema()
    click.echo(json.dumps(found, indent=2))


@click.group()
def cache():
    """Look at the cache, verify it, or remove what is old."""


FOLDER = click.option("-w", "--cache", "root", type=FILE, metavar="DIR",
                      help="Cache.  [$XFEMNAV_CACHE, else ~/.cache/xfemnav]")


def _opened(root):
    from xfemnav.pipeline.cache import Cache
    from xfemnav.pipeline.job import default_cache

    return Cache(root or default_cache())


@cache.command()
@FOLDER
def ls(root):
    """List the entries: key and size."""
    found = _opened(root)
    keys = found.keys()
    sizes = dict(zip(keys, map(found.size, keys)))
    for key, size in sizes.items():
        click.echo(f"{key[:12]}  {size / 1e6:9.3f} MB")
    click.echo(f"{len(sizes)} entries, {sum(sizes.values()) / 1e6:.1f} MB in {found.root}")


@cache.command()
@FOLDER
def verify(root):
    """Check every byte of every entry; damaged ones are set aside and will be computed again."""
    found = _opened(root)
    damaged = found.set_aside_damaged()
    for key in damaged:
        click.echo(f"{key[:12]}  damaged, set aside")
    click.echo(f"{len(found.keys())} entries are whole, {len(damaged)} were damaged")
    return EXIT_DATA if damaged else 0


@cache.command()
@FOLDER
@click.option("--days", type=click.FloatRange(0), default=30.0, show_default=True, help="Keep what was used in them.")
def prune(root, days):
    """Remove entries that were not used for some days, and all debris."""
    count, size = _opened(root).prune(days * 86400)
    click.echo(f"{count} entries removed, {size / 1e6:.1f} MB freed")
