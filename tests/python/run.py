#!/usr/bin/env python3
"""Runs the Python tests of this folder: programs nobody here wrote read, write and drive what `gadm-sim` puts on a bus.

Usage: target/python/bin/python tests/python/run.py [NAME ...]

NAME picks tests whose name contains it. Every test ends in a line `ok: NAME`, `FAILED: NAME` or `not run: NAME (why)`.
The programs are taken from the debug build, or from the folder in GADM_BIN.
"""

import sys
import unittest
from pathlib import Path

HERE = Path(__file__).resolve().parent


class Result(unittest.TextTestResult):
    """Says of every test, in one line, how it went."""

    def say(self, word, test, why=""):
        print(f"{word}: {test.id()}{f' ({why})' if why else ''}", flush=True)

    def addSuccess(self, test):
        super().addSuccess(test)
        self.say("ok", test)

    def addError(self, test, err):
        super().addError(test, err)
        self.say("FAILED", test)

    def addFailure(self, test, err):
        super().addFailure(test, err)
        self.say("FAILED", test)

    def addSkip(self, test, reason):
        super().addSkip(test, reason)
        self.say("not run", test, reason)


def chosen(suite, words):
    for test in suite:
        if isinstance(test, unittest.TestSuite):
            yield from chosen(test, words)
        elif not words or any(word in test.id() for word in words):
            yield test


def main(words):
    sys.path.insert(0, str(HERE))
    found = unittest.defaultTestLoader.discover(str(HERE), pattern="test_*.py")
    tests = unittest.TestSuite(chosen(found, words))
    if tests.countTestCases() == 0:
        print(f"run.py: no test is named {' or '.join(words)}", file=sys.stderr)
        return 2
    runner = unittest.TextTestRunner(stream=sys.stderr, resultclass=Result, verbosity=0)
    return 0 if runner.run(tests).wasSuccessful() else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
