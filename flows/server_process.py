"""Be the Prefect server, on 127.0.0.1, for as long as somebody holds the lock of its users."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time

from fieldcal.file_locks import fcntl

POLL_S = 0.25
UNUSED_S = 2.0
GRACE_S = 10.0


def main(port: socket.socket, users: str, *, serving: bool) -> None:
    """Serve until nobody has used the server for `UNUSED_S`, the time it needs to write its last records.

    Parameters
    ----------
    port : socket
        Bound to 127.0.0.1 by who started this process.
    users : str
        File on which every user holds a shared lock.
    serving : bool
        Whether to run the services that schedules and triggers need.
    """
    threading.Thread(target=_end_when_unused, args=(users,), daemon=True).start()
    import uvicorn
    from prefect.server.api.server import create_app

    app = create_app(ephemeral=not serving, final=True)
    settings = uvicorn.Config(app, log_level="error", lifespan="on", timeout_graceful_shutdown=2)
    uvicorn.Server(settings).run(sockets=[port])


def _end_when_unused(users: str) -> None:
    descriptor = os.open(users, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    unused_since: float | None = None
    while True:
        time.sleep(POLL_S)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            unused_since = None
            continue
        now = time.monotonic()
        unused_since = now if unused_since is None else unused_since
        if now - unused_since > UNUSED_S:
            break  # the lock stays: whoever comes now waits until this process has ended
        fcntl.flock(descriptor, fcntl.LOCK_UN)
    os.kill(os.getpid(), signal.SIGTERM)
    threading.Timer(GRACE_S, os._exit, (1,)).start()


if __name__ == "__main__":
    main(socket.socket(fileno=int(sys.argv[1])), sys.argv[2], serving="serving" in sys.argv[3:])
