"""Draw the measured test part of a record and the free run of the model that `select` chooses, for docs/real.md."""

import argparse
import sys
import warnings
from pathlib import Path

import koopmpc as km
from koopmpc.views.figures.style import save
from tests.real.judge import names, records_of

ROWS = 400  # rows that a picture shows, at most


def draw(name: str, folder: Path) -> Path:
    """Write the picture of one record or twin (its first seed), and return its path."""
    record = records_of(name)[0]
    learn, test = (
        km.Episodes([km.Episode(X=Y, U=U[:-1])], record.dt, record.outputs, record.inputs)
        for Y, U in ((record.Y_learn, record.U_learn), (record.Y_test, record.U_test))
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", km.FitWarning)
        model = km.select(learn).predictor
    episode = model.align(test)[0]
    past = 0 if model.embedding is None else model.embedding.steps
    horizon = min(ROWS, len(episode) - past)
    picture = km.plot.rollout(
        model, episode, horizon, relift=isinstance(model, km.BilinearPredictor), width="two columns"
    )
    path = folder / f"real_{name.replace(',', '').replace(' ', '_')}.png"
    save(picture, path)
    return path


def main() -> None:
    """Draw the records that are asked for."""
    parser = argparse.ArgumentParser(prog="python -m tests.real.pictures", description=__doc__)
    parser.add_argument("records", nargs="+", choices=names())
    parser.add_argument("--folder", type=Path, default=Path(__file__).parents[2] / "docs" / "pictures")
    asked = parser.parse_args()
    for name in asked.records:
        sys.stdout.write(f"{draw(name, asked.folder)}\n")


if __name__ == "__main__":
    main()
