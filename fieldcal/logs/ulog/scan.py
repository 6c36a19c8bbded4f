"""Where the messages of a ULog file are: from one pass over its bytes, and on behind damage.

A message is found by the size of the one before. That alone is no proof: what follows must fit too. So a data message
counts once a message that fits stands behind it, and where none does, it is left out with what follows, and the search
goes on for a message with several behind it that fit.
"""

from __future__ import annotations

import mmap
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fieldcal.logs.ulog import records
from fieldcal.logs.ulog.records import HEAD_BYTES, KINDS, LARGEST_PAYLOAD, MESSAGE_ID_BYTES, Topic

Data = bytes | mmap.mmap
Offsets = NDArray[np.int64]

BLOCK_BYTES = 1 << 19
FIRST_MESSAGES, ALL_MESSAGES = 64, 1 << 20
SEARCH_BYTES, MOST_SEARCH_BYTES = 1 << 12, 1 << 18
SUCCESSORS = 3
IDS = 1 << 16

_IS_KIND = np.zeros(records.KIND_COUNT, bool)
_IS_KIND[list(KINDS)] = True
_SELF_EVIDENT = (records.FORMAT, records.SUBSCRIPTION, records.SYNC_KIND)
"""Kinds whose whole content is checked, so that they count whatever follows."""
_PROOF = (*_SELF_EVIDENT, records.INFO, records.INFO_MULTIPLE, records.PARAMETER, records.PARAMETER_DEFAULT)
"""Kinds that hardly any bytes fit by chance."""


@dataclass
class Losses:
    """What could not be read. `messages`: whole ones that were left out because nothing fitting followed."""

    places: int = 0
    lost_bytes: int = 0
    messages: int = 0
    cut_bytes: int = 0


@dataclass
class Sizes:
    """Payload sizes of the data messages that are subscribed, by message id; 0 where there is none."""

    least: NDArray[np.int64] = field(default_factory=lambda: np.zeros(IDS, np.int64))
    largest: NDArray[np.int64] = field(default_factory=lambda: np.zeros(IDS, np.int64))

    def learn(self, topic: Topic) -> None:
        """Take a subscription."""
        self.least[topic.message_id], self.largest[topic.message_id] = topic.sizes

    def copy(self) -> Sizes:
        """One that learns by itself."""
        return Sizes(self.least.copy(), self.largest.copy())


@dataclass(frozen=True)
class Found:
    """Messages of one block in file order: `starts` in the file, `kinds`, and the `ids` of data messages (else 0)."""

    block: bytes
    begin: int
    starts: Offsets
    kinds: NDArray[np.uint8]
    ids: NDArray[np.uint16]

    def payload(self, index: int) -> bytes:
        """Content of a message."""
        start = int(self.starts[index]) - self.begin
        return self.block[start + HEAD_BYTES : start + HEAD_BYTES + _size(self.block, start)]


class Scan:
    """A walk through bytes `start` to `end`.

    Parameters
    ----------
    data : bytes or mmap
    sizes : Sizes
        Of what is subscribed so far; the caller teaches it what the messages that it is handed subscribe.
    subscribes : callable
        From the payloads of a format and of a subscription in a block that is being judged to the topics it defines.
    losses : Losses
        Counts what is left out.
    """

    def __init__(
        self,
        data: Data,
        sizes: Sizes,
        subscribes: Callable[[list[tuple[int, bytes]]], list[Topic]],
        losses: Losses,
    ) -> None:
        self._data = data
        self._sizes = sizes
        self._subscribes = subscribes
        self._losses = losses

    def messages(self, start: int, end: int) -> Iterator[Found]:
        """The messages that count, block by block."""
        position, most = start, FIRST_MESSAGES
        while position < end:
            block = self._data[position : min(position + BLOCK_BYTES, end)]
            starts, stop = _chain(block, most)
            whole = position + stop == end
            more = position + len(block) < end or (len(starts) == most and not whole)
            found = self._found(block, position, starts)
            count, proof = self._judge(found)
            keep = count if whole else self._carried(found, proof, count)
            if count == len(starts) == most and not whole and not keep:
                most *= 4
                continue
            if count == len(starts) and keep and (whole or (more and stop)):
                yield _first(found, keep)
                position = end if whole else position + (int(starts[keep]) if keep < count else stop)
                most = min(4 * most, ALL_MESSAGES)
                continue
            if count == len(starts) and not more and self._begins_data(block, stop):  # the end was cut within it
                yield found
                self._losses.cut_bytes += len(block) - stop
                return
            keep = self._trusted(found, proof, count)
            yield _first(found, keep)
            bad = position + (int(starts[keep]) if keep < len(starts) else stop)
            kept = found.kinds[keep:count]
            self._losses.messages += int(np.count_nonzero(kept == records.DATA))
            resumed = self._resume(bad + 1, end)
            if resumed < end:
                self._losses.places += 1
                self._losses.lost_bytes += resumed - bad
            else:
                self._losses.cut_bytes += end - bad
            position, most = resumed, FIRST_MESSAGES

    def _found(self, block: bytes, begin: int, starts: Offsets) -> Found:
        content = np.frombuffer(block, np.uint8)
        kinds = content[starts + 2] if len(starts) else np.empty(0, np.uint8)
        low = content[np.minimum(starts + 3, len(content) - 1)]
        high = content[np.minimum(starts + 4, len(content) - 1)]
        ids = np.where(kinds == records.DATA, low.astype(np.uint16) | (high.astype(np.uint16) << 8), 0)
        return Found(block, begin, starts + begin, kinds, ids.astype(np.uint16))

    def _judge(self, found: Found) -> tuple[int, NDArray[np.bool_]]:
        """How many of the messages fit from the first on, and which are hardly there by chance."""
        count = len(found.starts)
        proof = np.isin(found.kinds, _PROOF)
        others: list[tuple[int, bytes]] = []
        for index in np.flatnonzero(found.kinds != records.DATA).tolist():
            kind, payload = int(found.kinds[index]), found.payload(index)
            if not records.fits(kind, payload):
                count = index
                break
            if kind in (records.FORMAT, records.SUBSCRIPTION):
                others.append((kind, payload))
        sizes = self._sizes
        if others:
            sizes = sizes.copy()
            for topic in self._subscribes(others):
                sizes.learn(topic)
        content = np.frombuffer(found.block, np.uint8)
        at = found.starts - found.begin
        payload_sizes = content[at].astype(np.int64) | (content[at + 1].astype(np.int64) << 8)
        least, largest = sizes.least[found.ids], sizes.largest[found.ids]
        data = found.kinds == records.DATA
        known = data & (least > 0)
        right = (payload_sizes == least) | (payload_sizes == largest)
        wrong = (known & ~right) | (data & (payload_sizes < MESSAGE_ID_BYTES))
        if wrong.any():
            count = min(count, int(np.argmax(wrong)))
        return count, proof | (known & right)

    def _carried(self, found: Found, proof: NDArray[np.bool_], count: int) -> int:
        """Of a block that goes on: how many count now. The last proof is looked at once more with what follows; a data
        message that none follows does not count."""
        proofs = np.flatnonzero(proof[1:count])
        unproven = count > 0 and bool(proof[0]) and found.kinds[0] == records.DATA
        return int(proofs[-1]) + 1 if len(proofs) else 0 if unproven else count

    def _trusted(self, found: Found, proof: NDArray[np.bool_], count: int) -> int:
        """Of a block in which message `count` does not fit: how many before it count.

        The last that fits may have lost or gained bytes: then its own end is not where its size says.
        """
        proofs = np.flatnonzero(proof[:count])
        if not len(proofs):
            return 0
        last = int(proofs[-1])
        return last + 1 if found.kinds[last] in _SELF_EVIDENT else last

    def _begins_data(self, block: bytes, at: int) -> bool:
        head = block[at : at + HEAD_BYTES + MESSAGE_ID_BYTES]
        if len(head) < HEAD_BYTES + MESSAGE_ID_BYTES or head[2] != records.DATA:
            return False
        number, size = head[3] | head[4] << 8, head[0] | head[1] << 8
        return size in (int(self._sizes.least[number]), int(self._sizes.largest[number]))

    def _resume(self, start: int, end: int) -> int:
        """Where the next message begins that has others behind it; `end` where there is none."""
        window = SEARCH_BYTES
        while start < end:
            block = self._data[start : min(start + window + HEAD_BYTES + LARGEST_PAYLOAD + HEAD_BYTES, end)]
            for at in self._candidates(block, min(window, end - start)).tolist():
                if self._followed(start + at, end):
                    return start + int(at)
            start, window = min(start + window, end), min(4 * window, MOST_SEARCH_BYTES)
        return end

    def _candidates(self, block: bytes, count: int) -> Offsets:
        content = np.frombuffer(block, np.uint8)
        at = np.flatnonzero(_IS_KIND[content[2 : count + 2]])
        size = content[at].astype(np.int64) | (content[at + 1].astype(np.int64) << 8)
        after = at + HEAD_BYTES + size
        inside = after <= len(content)
        at, size, after = at[inside], size[inside], after[inside]
        data = content[at + 2] == records.DATA
        wide = np.minimum(at + 4, len(content) - 1)
        number = content[np.minimum(at + 3, len(content) - 1)].astype(np.int64) | (content[wide].astype(np.int64) << 8)
        least = self._sizes.least[number]
        right = (least > 0) & ((size == least) | (size == self._sizes.largest[number]))
        behind = after + 2 >= len(content)
        behind |= _IS_KIND[content[np.minimum(after + 2, len(content) - 1)]]
        return at[behind & (right | (~data & np.isin(content[at + 2], _PROOF)))]

    def _followed(self, at: int, end: int) -> bool:
        """Whether a whole message and `SUCCESSORS` more, or the end, stand here."""
        for _ in range(SUCCESSORS + 1):
            if at == end:
                return True
            head = self._data[at : at + HEAD_BYTES + MESSAGE_ID_BYTES]
            if len(head) < HEAD_BYTES:
                return False
            after = at + HEAD_BYTES + (head[0] | head[1] << 8)
            if after > end:
                return self._begins_data(head, 0)
            if head[2] == records.DATA:
                number = head[3] | head[4] << 8 if len(head) == HEAD_BYTES + MESSAGE_ID_BYTES else 0
                least = int(self._sizes.least[number])
                if least and after - at - HEAD_BYTES not in (least, int(self._sizes.largest[number])):
                    return False
            elif not records.fits(head[2], self._data[at + HEAD_BYTES : after]):
                return False
            at = after
        return True


def _chain(block: bytes, most: int) -> tuple[Offsets, int]:
    """Starts of the messages that lie whole in a block, by their sizes alone, and where the next one begins."""
    starts: list[int] = []
    add = starts.append
    position, last = 0, len(block) - HEAD_BYTES
    for _ in range(most):
        if position > last:
            break
        add(position)
        position += block[position] + (block[position + 1] << 8) + HEAD_BYTES
    if position > len(block):
        position = starts.pop()
    return np.array(starts, np.int64), position


def _first(found: Found, count: int) -> Found:
    return Found(found.block, found.begin, found.starts[:count], found.kinds[:count], found.ids[:count])


def _size(block: bytes, start: int) -> int:
    return block[start] | block[start + 1] << 8
