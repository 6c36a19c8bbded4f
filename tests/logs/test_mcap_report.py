"""What a pass through an MCAP file met, as findings: each code, count and loss by itself."""

from __future__ import annotations

from fieldcal.logs.interface import LogSummary
from fieldcal.logs.mcap import records
from fieldcal.logs.mcap.report import Tally, report
from fieldcal.logs.messages.definitions import Definitions

TOPICS = Definitions(channels={i: records.Channel(i, 0, f"/t{i}", "cdr", ()) for i in range(1, 13)})
Told = list[tuple[str, int, bool, bool]]


def told(
    tally: Tally, statistics: records.Statistics | None = None, known: Definitions = TOPICS
) -> tuple[Told, str, bool]:
    """(code, count, loses data, fatal) of every finding, all sentences, and whether the file can be verified."""
    summary = LogSummary("mcap")
    report("a.mcap", 999, tally, known, statistics, summary)
    found = [(str(f.code), f.count, f.loses_data, f.fatal) for f in summary.findings]
    return found, " ".join(f.sentence for f in summary.findings), summary.verifiable


def counted(**counts: int) -> records.Statistics:
    channels = {int(name[1:]): count for name, count in counts.items()}
    return records.Statistics(sum(channels.values()), 1, channels)


def test_a_whole_file_has_nothing_told() -> None:
    tally = Tally(ended=True)
    tally.messages.update({1: 5, 2: 6})
    assert told(tally) == ([], "", True)
    assert told(tally, counted(c1=5, c2=6)) == ([], "", True)


def test_messages_that_are_missing_are_counted_by_topic() -> None:
    tally = Tally(ended=True)
    tally.messages.update({1: 5, 2: 6})
    found, words, _ = told(tally, counted(c1=7, c2=6, c3=4))
    assert found == [("count_mismatch", 6, True, False)]
    assert "Lost: /t1 2, /t3 4." in words
    found, words, _ = told(tally, counted(c1=5, c2=2))
    assert found == [("count_mismatch", 4, False, False)]
    assert "say: /t2 4." in words
    found, words, _ = told(tally, counted(c2=6))
    assert found == [("count_mismatch", 5, False, False)]


def test_damage_loses_data_unless_the_files_own_count_says_otherwise() -> None:
    def tally() -> Tally:
        made = Tally(ended=True, damaged_chunks=[(8, "why"), (90, "too")], damaged_records=[(30, "odd")])
        made.messages.update({1: 5})
        return made

    found, words, _ = told(tally())
    assert found == [("damaged_chunk", 2, True, False), ("damaged_record", 1, True, False)]
    assert "2 damaged chunk(s), the first at byte 8 (why)" in words
    assert "Messages lost are not counted in the file." in words
    assert "1 damaged record(s) outside chunks, the first at byte 30 (odd)" in words
    found, _, _ = told(tally(), counted(c1=5))
    assert found == [("damaged_chunk", 2, False, False), ("damaged_record", 1, False, False)]
    found, words, _ = told(tally(), counted(c1=8))
    assert found == [("damaged_chunk", 2, True, False), ("damaged_record", 1, True, False)]
    assert "Messages lost: /t1 3." in words
    found, _, _ = told(tally(), records.Statistics(9, 1, {1: 5}))  # a total that its channels do not add up to
    assert found[0] == ("damaged_chunk", 2, True, False)
    indexed = tally()
    indexed.lost.update({2: 4})
    assert "Messages lost: /t2 4." in told(indexed)[1]


def test_a_cut_is_told_unless_everything_was_there_or_the_search_was_stopped() -> None:
    cut = Tally()
    cut.messages.update({1: 5})
    found, words, _ = told(cut)
    assert found == [("truncated", 1, True, False)]
    assert "has 999 bytes" in words
    assert told(cut, counted(c1=5))[0] == []
    assert told(cut, counted(c1=6))[0] == [("truncated", 1, True, False), ("count_mismatch", 1, True, False)]
    cut.stopped = "enough"
    found, words, _ = told(cut)
    assert found == [("search_cap", 1, True, False)]
    assert "enough; the rest was not read" in words


def test_contradictions() -> None:
    tally = Tally(ended=True, duplicate_chunks=3, summary_damage="torn", unverifiable=2)
    tally.unknown_channels.update({40: 2, 41: 3})
    known = Definitions(channels=TOPICS.channels, redefined={f"channel {i}": None for i in range(8)})
    found, words, verifiable = told(tally, known=known)
    assert found == [
        ("unknown_channel", 5, True, False),
        ("duplicate_chunk", 3, False, False),
        ("damaged_summary", 1, False, False),
        ("channel_redefined", 8, False, True),
        ("unverifiable", 2, False, False),
    ]
    assert "defines channel 0, channel 1, channel 2, channel 3, channel 4 twice" in words
    assert "(torn)" in words
    assert not verifiable


def test_eight_topics_are_listed_and_undefined_ones_by_number() -> None:
    tally = Tally(ended=True)
    _, words, _ = told(tally, records.Statistics(12, 1, {**dict.fromkeys(range(4, 13), 1), 0: 3}))
    assert "Lost: channel 0 3, /t4 1, /t5 1, /t6 1, /t7 1, /t8 1, /t9 1, /t10 1." in words


def test_the_damage_at_the_end_of_a_cut_file_is_forgotten() -> None:
    tally = Tally(damaged_chunks=[(5, "a"), (50, "b")], damaged_records=[(20, "c")])
    for left in (([(5, "a")], [(20, "c")]), ([(5, "a")], []), ([], [])):
        tally.forget_cut()
        assert (tally.damaged_chunks, tally.damaged_records) == left


def test_repetitions_are_no_redefinitions_and_the_first_definition_stands() -> None:
    known = Definitions()
    first, second = records.Channel(1, 0, "/a", "cdr", ()), records.Channel(1, 0, "/b", "cdr", ())
    schema = records.Schema(1, "A", "ros2msg", b"")
    for definition in (first, first, schema, schema):
        known.add(definition)
    assert known.redefined == {}
    known.add(second)
    known.add(records.Schema(1, "B", "ros2msg", b""))
    assert [*known.redefined] == ["channel 1 (/b)", "schema 1 (B)"]
    assert known.channels == {1: first}
    known.add(records.Channel(2, 0, "/a", "cdr", ()))
    assert known.by_topic() == {"/a": [first, records.Channel(2, 0, "/a", "cdr", ())]}
