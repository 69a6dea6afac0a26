"""Tables and figures of the paper in one report. `python -m experiments.paper`, or parts of it by their names

To MLflow: `torchmbd run configs/paper.yaml`. Parts that are done are read from .torchmbd/paper (`TORCHMBD_STORE`).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from experiments.paper import report
from experiments.paper.parts import PARTS, chosen, run
from torchmbd.study.record.paths import studies_folder


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("parts", nargs="*", help="default: all but those of more than ten minutes")
    parser.add_argument("--list", action="store_true", help="names, titles and minutes of all parts")
    parser.add_argument("--long", action="store_true", help="also the parts of more than ten minutes")
    parser.add_argument("--fresh", action="store_true", help="compute again what is done")
    parser.add_argument("--report", type=Path, default=Path("paper.html"))
    arguments = parser.parse_args()
    if arguments.list:
        for part in PARTS:
            print(f"{part.name:16s} {part.minutes:5.1f} min  {part.title}")
        return
    torch.set_num_threads(1)
    findings = run(chosen(arguments.parts, arguments.long), studies_folder() / "paper", arguments.fresh)
    for finding in findings:
        print(f"\n{finding.part.title}")
        for row in finding.rows:
            ratio = "" if row.ratio is None else f"{row.ratio:.3f}"
            print(
                f"  {row.what:58s} {report.number_text(row.paper):>22s} {report.number_text(row.ours):>22s} "
                f"{ratio:>7s}  {row.label}"
            )
    print(f"\n{report.write(findings, arguments.report)}")


if __name__ == "__main__":
    main()
