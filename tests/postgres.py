"""A real PostgreSQL for the tests that need one, out of Debian's package: in a folder of its own, on loopback."""

import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from pathlib import Path

import psycopg

USER, PASSWORD = "aarl", "s3cret"


def free_port() -> int:
    """A port of loopback on which nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


class Postgres:
    """
    A cluster. The superuser ``aarl`` logs in with a password.

    :raises RuntimeError: when PostgreSQL is not installed, or does not start
    """

    def __init__(self) -> None:
        found = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: float(path.parent.name))
        which = shutil.which("postgres")
        if not found and which is None:
            raise RuntimeError("PostgreSQL is not installed: apt-get install postgresql (make test does it)")
        self._bin = found[-1] if found else Path(str(which)).parent
        self.port = free_port()
        self._folder = Path(tempfile.mkdtemp(prefix="aarl-postgres-"))
        password_file = self._folder / "password"
        password_file.write_text(PASSWORD)
        if os.getuid() == 0:  # it refuses to run as root
            user = pwd.getpwnam("postgres")
            for path in (self._folder, password_file):
                os.chown(path, user.pw_uid, user.pw_gid)
        options = f"--username={USER} --auth=scram-sha-256 --no-sync --no-locale --encoding=UTF8".split()
        initdb = self._run("initdb", *options, f"--pwfile={password_file}", "-D", str(self._folder / "data"))
        if initdb.wait() != 0:
            raise RuntimeError(self._log())
        self.start()

    def _run(self, program: str, *arguments: str) -> "subprocess.Popen[bytes]":
        user = {"user": "postgres", "group": "postgres", "extra_groups": []} if os.getuid() == 0 else {}
        with (self._folder / "log").open("ab") as log:
            command = [str(self._bin / program), *arguments]
            # A session of its own: Ctrl-C in the terminal is for the tests.
            return subprocess.Popen(
                command, cwd=self._folder, stdout=log, stderr=log, stdin=subprocess.DEVNULL, start_new_session=True, **user
            )

    def _log(self) -> str:
        return (self._folder / "log").read_text()[-2000:]

    def url(self, database: str = "postgres") -> str:
        """URL of a database, without the name of a driver."""
        return f"postgresql://{USER}:{PASSWORD}@127.0.0.1:{self.port}/{database}"

    def create(self, database: str) -> str:
        """Make a database; returns its URL."""
        with psycopg.connect(self.url(), autocommit=True) as connection:
            connection.execute(f'CREATE DATABASE "{database}"'.encode())
        return self.url(database)

    def start(self) -> None:
        """Start the server; returns when it accepts connections."""
        settings = f"port={self.port} listen_addresses=127.0.0.1 unix_socket_directories= fsync=off".split()
        words = [word for setting in settings for word in ("-c", setting)]
        self._process = self._run("postgres", "-D", str(self._folder / "data"), *words)
        deadline = time.monotonic() + 30
        while True:
            try:
                psycopg.connect(self.url(), connect_timeout=2).close()
                return
            except psycopg.OperationalError:
                if self._process.poll() is not None or time.monotonic() > deadline:
                    raise RuntimeError(self._log()) from None
                time.sleep(0.05)

    def crash(self) -> None:
        """Stop the server as after a loss of power: it has to recover when it is started."""
        self._process.send_signal(signal.SIGQUIT)
        self._process.wait(timeout=30)

    def close(self) -> None:
        """Stop the server and delete all that it has."""
        if self._process.poll() is None:
            self.crash()
        shutil.rmtree(self._folder, ignore_errors=True)
