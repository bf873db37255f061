"""Measures like `gadm bench`: chunks of about a fiftieth of a second, rates by wall clock and by processor time."""

import json
import sys
import time


def repeat(work, seconds, warm_s=None):
    """Runs `work` (which returns how many units it did) for `seconds`; returns the rates of the chunks."""
    start, pieces = time.perf_counter(), 0
    warm_s = 0.1 * seconds if warm_s is None else warm_s
    while pieces == 0 or time.perf_counter() - start < warm_s:
        work()
        pieces += 1
    per_chunk = max(1, round(pieces * 0.02 / (time.perf_counter() - start)))
    rates, cpu_rates = [], []
    begin = time.perf_counter()
    while not rates or time.perf_counter() - begin < seconds:
        wall, cpu = time.perf_counter(), time.process_time()
        units = sum(work() for _ in range(per_chunk))
        rates.append(units / (time.perf_counter() - wall))
        cpu_rates.append(units / max(time.process_time() - cpu, 1e-9))
    return {"rates": rates, "cpu_rates": cpu_rates}


def serve(cases):
    """Answers requests `{"case": ..., "threads": ..., "seconds": ...}`, one a line, with one line of JSON each.

    The process stays between measurements, so that its start counts for nothing. `cases[name](threads)` returns the work.
    """
    made = {}
    for line in sys.stdin:
        request = json.loads(line)
        key = (request["case"], request["threads"])
        try:
            if key not in made:
                made[key] = cases[key[0]](key[1])
            prepare, work = made[key]
            prepare()
            answer = repeat(work, request["seconds"])
        except Exception as error:  # told to the caller, who reports the row as not run
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), flush=True)
