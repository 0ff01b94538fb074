"""An outlet of the Lab Streaming Layer in a process of its own: a twin of a pump's program.

Each channel of sample n holds n plus the number of the channel. Commands are lines on stdin: `step S` steps the clock
of its stamps by S seconds, `hold S` sends nothing for S seconds. At the end of stdin it ends.
"""

from __future__ import annotations

import argparse
import queue
import sys
import threading
import time

import numpy as np
import pylsl


def take_commands(commands: queue.Queue[str]) -> None:
    """Take the lines of stdin, and its end."""
    for line in sys.stdin:
        commands.put(line)
    commands.put("end")


def main() -> None:
    """Send until stdin ends."""
    parser = argparse.ArgumentParser()
    parser.add_argument("name")
    parser.add_argument("--rate", type=float, default=100.0)
    parser.add_argument("--channels", type=int, default=2)
    parser.add_argument("--source", default="")
    parser.add_argument("--unit", default="ul/min")
    parser.add_argument("--format", default="float32")
    asked = parser.parse_args()
    info = pylsl.StreamInfo(asked.name, "Pump", asked.channels, asked.rate, asked.format, asked.source)
    info.set_channel_labels([f"flow{number}" for number in range(asked.channels)])
    info.set_channel_units([asked.unit] * asked.channels)
    outlet = pylsl.StreamOutlet(info, max_buffered=60)
    commands: queue.Queue[str] = queue.Queue()
    threading.Thread(target=take_commands, args=(commands,), daemon=True).start()
    sent, step_s, held_s = 0, 0.0, 0.0
    began_s = pylsl.local_clock()
    print("ready", repr(began_s), flush=True)
    while True:
        try:
            word, _, value = commands.get_nowait().partition(" ")
        except queue.Empty:
            pass
        else:
            if word == "end":
                print(sent, flush=True)
                return
            step_s += float(value) if word == "step" else 0.0
            if word == "hold":
                time.sleep(float(value))
                held_s += float(value)
        due = int((pylsl.local_clock() - began_s - held_s) * asked.rate)
        if due > sent:
            numbers = np.arange(sent, due)
            values = (numbers[:, None] + np.arange(asked.channels)).astype(asked.format.replace("double64", "float64"))
            stamps = began_s + held_s + (numbers + 1) / asked.rate + step_s
            outlet.push_chunk(values, stamps)
            sent = due
        time.sleep(min(0.2 / asked.rate, 0.005))


if __name__ == "__main__":
    main()
