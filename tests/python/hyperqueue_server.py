"""A HyperQueue server, or a worker of one, as a process of its own: it says `ready` and serves until it is killed.

Usage: hyperqueue_server.py server FOLDER
       hyperqueue_server.py worker OWN_FOLDER SERVER_FOLDER

HyperQueue's Python package has server and workers, and no program that starts one worker. It starts a worker for the server
whose folder it finds under its own: a worker here makes a folder of its own and leads it to the server's.
"""

import signal
import sys
from pathlib import Path

from hyperqueue.ffi.cluster import Cluster

# HyperQueue's name for the folder of the server that runs now.
CURRENT = "hq-current"


def main(kind, *folders):
    own = Path(folders[0])
    cluster = Cluster(str(own))
    if kind == "worker":
        link = own / CURRENT
        link.unlink()
        link.symlink_to((Path(folders[1]) / CURRENT).resolve())
        cluster.add_worker(1)
    print("ready", flush=True)
    signal.pause()


if __name__ == "__main__":
    main(*sys.argv[1:])
