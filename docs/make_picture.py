"""Draw the README's picture from a store: ``python docs/make_picture.py STORE [DISTURBANCE]``."""

import sys
from pathlib import Path

from wavequake.campaign.store.store import open_store, read_manifest
from wavequake.report.figures import summary_figure
from wavequake.report.populations import populations, representatives
from wavequake.report.segments.report import detail


def main(store: str, disturbance: str | None = None) -> None:
    """Write docs/summary.png."""
    dataset, manifest = open_store(store), read_manifest(store)
    found = populations(dataset)
    _, worst = representatives(found)[disturbance or str(dataset.disturbance.values[0])]
    figure = summary_figure(detail(manifest.study, worst, manifest.device, dataset), found)
    figure.savefig(Path(__file__).with_name("summary.png"), dpi=110)


if __name__ == "__main__":
    main(*sys.argv[1:])
