"""DuckDB in a process of its own, which may be killed: `python engine.py`. It imports nothing of fieldcal.

It reads questions, one JSON object a line, and answers each: a line of JSON (`error`: what kind and DuckDB's own words,
or None), and without an error the result as an Arrow stream. The engine may open the files that a question names, for
reading; everything else external is switched off and the configuration locked before the query is looked at.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import threading
from datetime import date, datetime
from typing import Any, BinaryIO

import duckdb
import pyarrow as pa

READING = frozenset({"SELECT", "EXPLAIN"})
ROWS_PER_BATCH = 65_536
THREADS = 4
"""At most: every one takes address space, of which there is little."""
BESIDE_MB = 1024
"""Address space for what the engine's own limit does not count: plans, stacks, the result on its way."""
CONFIG: dict[str, Any] = {
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    "allow_community_extensions": False,
    "python_enable_replacements": False,
    "temp_directory": "",
    "threads": min(THREADS, os.cpu_count() or 1),
}


class Refused(Exception):
    """The statement is none that is answered here, or its answer too large; `kind` says which."""

    def __init__(self, kind: str, words: str) -> None:
        super().__init__(words)
        self.kind = kind


def limit_address_space(memory_mb: int) -> None:
    """Address space beyond what the process has now: what asks for more fails, also where the engine does not count."""
    try:
        with open("/proc/self/statm", encoding="ascii") as stream:
            now = int(stream.read().split()[0]) * resource.getpagesize()
    except OSError:  # not Linux, where nobody keeps such a limit either
        return
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    soft = now + (memory_mb + BESIDE_MB << 20)
    resource.setrlimit(resource.RLIMIT_AS, (soft if hard < 0 else min(soft, hard), hard))


def answer(question: dict[str, Any]) -> pa.Table:
    """The answer to one question."""
    memory_mb, most_mb = int(question["memory_mb"]), question["max_result_mb"]
    limit_address_space(memory_mb)
    with duckdb.connect(":memory:", config={**CONFIG, "memory_limit": f"{memory_mb}MB"}) as connection:
        for statement in question["made"]:
            connection.execute(statement)
        connection.execute("SET TimeZone = 'UTC'")
        connection.execute(f"SET allowed_paths = {question['paths']}")
        connection.execute("SET enable_external_access = false")
        connection.execute("SET lock_configuration = true")
        timer = threading.Timer(question["timeout_s"], connection.interrupt)
        timer.daemon = True
        timer.start()
        try:
            statements = connection.extract_statements(question["query"])
            kinds = [statement.type.name for statement in statements]
            if len(kinds) != 1 or kinds[0] not in READING:
                raise Refused("not one", ", ".join(kinds) or "nothing")
            relation = connection.sql(statements[0], params=parameters(question["parameters"]))
            reader = relation.to_arrow_reader(ROWS_PER_BATCH)
            batches, size = [], 0
            for batch in reader:
                size += batch.nbytes
                if size > most_mb << 20:
                    raise Refused("too large", "")
                batches.append(batch)
            return pa.Table.from_batches(batches, schema=reader.schema)
        finally:
            timer.cancel()


def parameters(given: list[list[Any]] | None) -> list[Any] | None:
    """What stands for the `?` marks: dates and times come as text with their kind."""
    if given is None:
        return None
    kinds = {"date": date.fromisoformat, "datetime": datetime.fromisoformat}
    return [kinds[kind](value) if kind in kinds else value for kind, value in given]


def kind_of(error: BaseException) -> str:
    """What kind of failure it was."""
    if isinstance(error, Refused):
        return error.kind
    kinds = (
        (duckdb.InterruptException, "timeout"),
        ((duckdb.OutOfMemoryException, MemoryError, pa.ArrowMemoryError), "memory"),
        (duckdb.PermissionException, "reach"),
        (duckdb.CatalogException, "catalog"),
    )
    return next((kind for classes, kind in kinds if isinstance(error, classes)), "wrong")


def serve(questions: BinaryIO, answers: BinaryIO) -> None:
    """Answer questions until there are no more."""
    for line in questions:
        table = None
        try:
            table = answer(json.loads(line))
            error = None
        except Exception as failure:
            error = [kind_of(failure), str(failure).strip()]
        answers.write(json.dumps({"error": error}).encode() + b"\n")
        if table is not None:
            with pa.ipc.new_stream(answers, table.schema) as stream:
                stream.write_table(table)
        answers.flush()


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that asks, which ends this one
    serve(sys.stdin.buffer, sys.stdout.buffer)
