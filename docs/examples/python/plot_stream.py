# SPDX-License-Identifier: Apache-2.0
"""Draws a stream while it is written: each field that is a number, over the last seconds.

    python3 plot_stream.py STREAM                  opens a window
    python3 plot_stream.py STREAM --out FILE.png   draws the next --seconds into a file

STREAM may be another host's, as odometry@pc1.
Needs matplotlib: apt-get install python3-matplotlib.
"""

import argparse
import sys
import time

import dssm
import numpy as np

try:
    import matplotlib
except ImportError:
    sys.exit("plot_stream.py needs matplotlib: apt-get install python3-matplotlib")


def numbers(rows: np.ndarray, name: str = "") -> dict[str, np.ndarray]:
    """The columns of all numbers in an array of values, by the names of their fields."""
    if rows.dtype.names is not None:
        found = {}
        for field in rows.dtype.names:
            found |= numbers(rows[field], f"{name}.{field}" if name else field)
        return found
    if rows.ndim == 1 and rows.dtype.kind in "biuf":
        return {name or "value": rows}
    return {}  # arrays and texts


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stream")
    parser.add_argument("--seconds", type=float, default=10, help="how much of the past is shown")
    parser.add_argument("--out", help="a file, in place of the window")
    options = parser.parse_args()
    if options.out:
        matplotlib.use("Agg")
    from matplotlib import pyplot

    reader = dssm.Session().reader(options.stream, wait=True, fetch_history=True)
    span_ns = int(options.seconds * 1e9)
    figure, axes = pyplot.subplots()

    def draw(patience: float) -> None:
        """Draws the past; waits so long for what is on its way from another host."""
        latest = reader.newest()
        if latest is None:
            return
        history = reader.history(latest.time_ns - span_ns, latest.time_ns + 1, wait=patience)
        age = (history.time_ns - latest.time_ns) / 1e9
        axes.clear()
        for name, column in numbers(history["value"]).items():
            axes.plot(age, column, label=name)
        axes.set(title=reader.name, xlabel="s before the newest sample")
        axes.legend(loc="upper left")

    if options.out:
        reader.wait()
        time.sleep(options.seconds)
        try:
            draw(patience=10)
        except dssm.Arriving as error:
            sys.exit(f"plot_stream.py: {error}")
        figure.savefig(options.out)
        return 0
    pyplot.ion()
    figure.show()
    while pyplot.fignum_exists(figure.number):  # until the window is closed
        if reader.wait(0.1):
            reader.seek(reader.newest_tid)
            try:
                draw(patience=0.1)
            except dssm.Arriving:
                pass  # the next samples come with another attempt
        figure.canvas.flush_events()
        time.sleep(0.03)  # as often as a person sees
    return 0


if __name__ == "__main__":
    sys.exit(main())
