"""Render worlds: `make worlds SEEDS="1 2"`, or `python -m worlds` under a Python that has bpy."""

from __future__ import annotations

import argparse
import importlib.util
import logging
from pathlib import Path

from worlds.world import make_world

_LOG = logging.getLogger(__name__)


def main() -> None:
    """Render one set of pictures for each seed, into FOLDER/world<seed>; go on where an earlier run stopped."""
    parser = argparse.ArgumentParser(prog="python -m worlds", description=main.__doc__)
    parser.add_argument("seeds", type=int, nargs="+", metavar="SEED", help="each seed is another world")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="for the sets, 20 MB each")
    parser.add_argument("--samples", type=int, default=10, help="rays per pixel; default 10")
    parser.add_argument("--scorer", type=Path, help="score.py to put beside the pictures, for `rhot evaluate pictures`")
    chosen = parser.parse_args()
    if chosen.scorer is not None and not chosen.scorer.is_file():
        parser.error(f"--scorer {chosen.scorer}: no such file; name the score.py of the rendered pictures")
    if importlib.util.find_spec("bpy") is None:
        parser.error("this Python has no bpy; `make worlds` installs it in an environment of its own")
    # Blender takes a second to load, and is not needed for --help.
    from worlds.blender.studio import render_world  # noqa: PLC0415

    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    for seed in chosen.seeds:
        render_world(make_world(seed), chosen.out / f"world{seed}", chosen.samples, chosen.scorer)
        _LOG.info("world %d is complete", seed)


if __name__ == "__main__":
    main()
