"""The checker finds what is wrong in histories made by hand, and nothing in those that are right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from tests.history.checker import check
from tests.history.events import Answer, Finding, History, Kind, Operation, Seen, Span, Subject

ANN = Subject("ann", "one", "a" * 64)
BEN = Subject("ben", "one", "a" * 64)
OTHER = Subject("ann", "two", "b" * 64)
BAD = Subject("ann", "bad", "c" * 64, sound=False)
IDS = {ANN: "id-ann", BEN: "id-ben", OTHER: "id-other", BAD: "id-bad"}


class Story:
    """A history that is written down: what is told one after another does not overlap, unless it says when."""

    def __init__(self) -> None:
        self.history = History(clock=lambda: self.now, admins=frozenset({"admin"}))
        self.now = 0.0

    def __call__(
        self,
        kind: Kind,
        subject: Subject | None = ANN,
        status: int | None = None,
        state: str | None = None,
        *,
        at: tuple[float, float] | None = None,
        caller: str | None = None,
        seen: Sequence[Seen] = (),
        server: str = "server 1",
        name: str | None = None,
        names: tuple[tuple[str, str], ...] = (),
        **answer: str,
    ) -> Operation:
        begun, ended = at or (self.now + 1, self.now + 2)
        surface = IDS[subject] if subject is not None and kind != "upload" else None
        if state is not None:
            assert subject is not None
            seen = (entry(subject, state),)
        asks = caller or (subject.owner if subject is not None else "ann")
        operation = Operation("client", server, kind, asks, subject, surface, begun, name=name)
        if status is not None:
            operation.ended, operation.answer = ended, Answer(status, tuple(seen), names=names, **answer)
        self.history.operations.append(operation)
        self.now = max(self.now, ended)
        return operation

    def upload(self, subject: Subject = ANN, state: str = "queued", **more: tuple[float, float]) -> None:
        self("upload", subject, 200 if state == "ready" else 202, state, **more)  # type: ignore[arg-type]

    def look(self, subject: Subject = ANN, state: str | None = "ready", **more: tuple[float, float] | str) -> None:
        self("look", subject, 404 if state is None else 200, state, **more)  # type: ignore[arg-type]

    def listed(self, *seen: Seen) -> None:
        self("list", None, 200, seen=seen)

    def end(self, server: str = "server 1") -> None:
        self.now += 1
        self.history.server_ended(server)

    def mark(self, kind: str) -> None:
        self.now += 1
        self.history.mark(kind)  # type: ignore[arg-type]

    @property
    def findings(self) -> list[Finding]:
        return check(self.history)

    @property
    def rules(self) -> list[str]:
        return [finding.rule for finding in self.findings]


def entry(subject: Subject, state: str, container: str | None = None) -> Seen:
    made = container or f"container of {subject}"
    return Seen(IDS[subject], state, subject.name, made if state == "ready" else None)


@pytest.fixture
def story() -> Story:
    return Story()


def test_a_history_in_order(story: Story) -> None:
    story.upload()
    story.look(state="building")
    story.look(state="queued")  # after a restart
    story.look()
    story("fetch", ANN, 200, sha256="container of one of ann", named="container of one of ann")
    story("values", ANN, 200, sha256=ANN.sha256)
    story.upload(BEN)
    story.upload(state="ready")
    story.listed(entry(ANN, "ready"), entry(BEN, "building"))
    story("delete", ANN, 403, caller="ben")
    story("delete", ANN, 204, caller="admin")
    story("delete", ANN, 404)
    story("fetch", ANN, 404)
    story.listed(entry(BEN, "ready"))
    story("upload", ANN, 507)
    story.look(state=None)
    story.upload(BAD)
    story.look(BAD, "failed")
    assert story.findings == []


def test_an_upload_that_is_lost(story: Story) -> None:
    story.upload()
    story.look(state=None)
    assert story.rules == ["lost"]
    (finding,) = story.findings
    assert [operation.kind for operation in finding.operations] == ["upload", "look"]
    assert "expected it to be building or failed or queued or ready or waiting, got absent" in str(finding)


def test_an_upload_that_a_list_does_not_show(story: Story) -> None:
    story.upload()
    story.upload(BEN)
    story.listed(entry(BEN, "queued"))
    assert story.rules == ["lost"]


def test_a_deleted_surface_that_comes_back(story: Story) -> None:
    story.upload()
    story("delete", ANN, 204)
    story.look(state=None)
    story.look()
    assert story.rules == ["came back"]


def test_a_delete_of_nothing_that_is_acknowledged(story: Story) -> None:
    story.upload()
    story("delete", ANN, 204)
    story("delete", ANN, 204)
    assert story.rules == ["came back"]


def test_a_state_that_goes_back(story: Story) -> None:
    story.upload()
    story.look()
    story.look(state="queued")
    assert story.rules == ["went back"]


def test_ready_then_gone(story: Story) -> None:
    story.upload()
    story.look()
    story("fetch", ANN, 404)
    assert story.rules == ["lost"]


def test_ready_then_without_its_bytes(story: Story) -> None:
    story.upload()
    story.look()
    story("fetch", ANN, 503, code="not-now")
    assert story.rules == []
    story("fetch", ANN, 409, code="not-ready")
    assert story.rules == ["went back"]


def test_failed_is_for_good_unless_it_is_pushed_again(story: Story) -> None:
    story.upload(BAD)
    story.look(BAD, "failed")
    story.upload(BAD)
    story.look(BAD, "building")
    assert story.findings == []
    story.look(BAD, "failed")
    story.look(BAD, "queued")
    assert story.rules == ["order"]


def test_what_waits_is_built_after_all(story: Story) -> None:
    story.upload()
    story.look(state="waiting")
    story("fetch", ANN, 503, code="waiting")
    story("retry", ANN, 202, "queued")
    story.look()
    assert story.findings == []


def test_other_bytes_under_an_id(story: Story) -> None:
    story.upload()
    story("look", ANN, 200, seen=(entry(ANN, "ready", "this"),))
    story("look", ANN, 200, seen=(entry(ANN, "ready", "that"),))
    assert story.rules == ["other bytes"]


def test_another_container_than_the_one_that_was_named(story: Story) -> None:
    story.upload()
    story("fetch", ANN, 200, sha256="this", named="that")
    assert "wrong bytes" in story.rules


def test_other_values_than_those_that_were_uploaded(story: Story) -> None:
    story.upload()
    story("values", ANN, 200, sha256=OTHER.sha256)
    assert story.rules == ["wrong bytes"]


def test_one_container_for_two_uploads(story: Story) -> None:
    for subject in (ANN, OTHER):
        story.upload(subject)
        story("look", subject, 200, seen=(entry(subject, "ready", "the same"),))
    assert story.rules == ["other bytes"]


def test_one_container_for_two_owners_of_the_same(story: Story) -> None:
    for subject in (ANN, BEN):
        story.upload(subject)
        story("look", subject, 200, seen=(entry(subject, "ready", "the same"),))
    assert story.findings == []


def test_a_name_that_is_lost(story: Story) -> None:
    story.upload()
    story("look", ANN, 200, seen=(Seen(IDS[ANN], "queued", None),))
    story.listed(Seen(IDS[ANN], "queued", "another"))
    assert story.rules == ["name", "name"]


def test_surfaces_of_two_owners_that_are_mixed(story: Story) -> None:
    story.upload()
    story("upload", BEN, 202, seen=(entry(ANN, "queued"),))
    assert story.rules == ["mixed"]


def test_a_surface_with_two_ids(story: Story) -> None:
    story.upload()
    story("upload", ANN, 202, seen=(Seen("another", "queued", ANN.name),))
    assert story.rules == ["id"]


def test_another_surface_than_the_one_that_was_asked_for(story: Story) -> None:
    story.upload()
    story.upload(OTHER)
    story("look", ANN, 200, seen=(Seen(IDS[OTHER], "queued", ANN.name),))
    assert story.rules == ["another surface"]


def test_what_is_not_theirs(story: Story) -> None:
    story.upload()
    story("delete", ANN, 204, caller="ben")
    story.upload()
    story("delete", ANN, 403)
    assert story.rules == ["not theirs", "not theirs"]


def test_an_answer_that_nobody_may_get(story: Story) -> None:
    story.upload()
    story("delete", ANN, 500, code="internal")
    assert story.rules == ["answer"]


def test_what_can_be_read_and_is_refused_and_the_other_way_round(story: Story) -> None:
    story.upload()
    story.look(state="failed")
    story.upload(BAD)
    story.look(BAD, "ready")
    assert story.rules == ["refused", "wrong bytes"]


def test_a_surface_that_nobody_has_pushed(story: Story) -> None:
    story.upload()
    story.listed(entry(ANN, "queued"), entry(OTHER, "queued"))
    assert story.rules == ["nobody's"]


def test_a_state_that_no_surface_has(story: Story) -> None:
    story.upload()
    story.look(state="thinking")
    assert story.rules == ["state", "order"]


def test_what_was_never_answered_happens_or_not(story: Story) -> None:
    story.upload()
    story("delete", ANN)
    story.look(state="queued")
    story.look(state="ready")
    story.look(state=None)  # much later
    story("upload", ANN)
    story.look(state=None)
    story.look(state="building")
    assert story.findings == []
    story.look(state=None)
    assert story.rules == ["lost"]  # it was deleted once only


def test_what_was_never_answered_has_happened_when_its_server_ends_or_never(story: Story) -> None:
    story.upload()
    story("delete", ANN)
    story.end()
    story.look(state="queued", at=(11, 12))
    assert story.findings == []
    story.look(state=None, at=(13, 14))
    assert story.rules == ["lost"]


def test_what_another_server_was_asked_may_still_happen(story: Story) -> None:
    story.upload()
    story("delete", ANN, server="server 2")
    story.end("server 1")
    story.look(state="queued", at=(11, 12))
    story.look(state=None, at=(13, 14))
    assert story.findings == []


def test_what_happens_at_the_same_time_has_any_order(story: Story) -> None:
    story.upload(at=(0, 10))
    story("delete", ANN, 204, at=(0, 10))
    story.upload(at=(0, 10))
    story.look(state=None, at=(1, 2))
    story.look(state="queued", at=(3, 4))
    story.look(state=None, at=(5, 6))
    story.look(state="ready", at=(7, 8))
    assert story.findings == []
    story.look(state=None, at=(9, 10))
    assert story.rules == ["lost"]  # that would take another delete


def test_an_answer_may_be_older_than_its_end(story: Story) -> None:
    # Stored, then seen, then deleted by others before whoever uploaded it was answered.
    story.upload(at=(0, 10))
    story.look(state="ready", at=(1, 2))
    story("delete", ANN, 204, at=(3, 4))
    story.look(state=None, at=(5, 6))
    assert story.findings == []


def backup(story: Story, *during: str) -> None:
    story.upload()
    story.look()
    story.mark("backup begins")
    for what in during:
        if what == "delete":
            story("delete", ANN, 204)
        else:
            story.upload(OTHER)
    story.mark("backup ends")


def test_what_was_acknowledged_before_a_backup_is_restored(story: Story) -> None:
    backup(story)
    story("delete", ANN, 204)
    story.end()
    story.mark("restored")
    story.look()
    assert story.findings == []
    story.history.operations.pop()
    story.look(state="queued")
    assert story.rules == ["went back"]
    story.history.operations.pop()
    story.look(state=None)
    assert story.rules == ["lost"]


@pytest.mark.parametrize("state", ["queued", "ready", None])
def test_what_was_deleted_during_a_backup_is_there_or_not_or_not_built(story: Story, state: str | None) -> None:
    backup(story, "delete")
    story.end()
    story.mark("restored")
    story.look(state=state)
    assert story.findings == []


@pytest.mark.parametrize("state", ["queued", "ready", None])
def test_what_was_uploaded_during_a_backup_is_there_or_not(story: Story, state: str | None) -> None:
    backup(story, "upload")
    story.end()
    story.mark("restored")
    story.look(OTHER, state)
    assert story.findings == []


def test_what_was_uploaded_after_a_backup_is_not_restored(story: Story) -> None:
    backup(story)
    story.upload(OTHER)
    story.end()
    story.mark("restored")
    story.look(OTHER, None)
    assert story.findings == []
    story.look(OTHER, "ready")
    assert story.rules == ["came back"]


def test_half_a_surface_that_was_restored_is_whole_once_it_is_pushed_again(story: Story) -> None:
    backup(story, "delete")
    story.end()
    story.mark("restored")
    story.look(state="ready")
    story("fetch", ANN, 409, code="not-ready")
    story.look(state="waiting")
    story.upload()
    story.look(state="ready")
    assert story.findings == []
    story("fetch", ANN, 409, code="not-ready")
    assert story.rules == ["went back"]


def test_half_a_surface_that_was_restored_and_that_a_push_leaves_so(story: Story) -> None:
    backup(story, "delete")
    story.end()
    story.mark("restored")
    story.upload(state="ready")
    story("fetch", ANN, 409, code="not-ready")
    assert story.rules == ["went back"]


def named(story: Story, status: int | None = 200, subject: Subject = ANN) -> None:
    story("point", subject, status, name="latest")


def test_a_name_leads_to_what_it_was_pointed_to_last(story: Story) -> None:
    story.upload()
    story.upload(OTHER)
    named(story)
    story("follow", None, 200, name="latest", seen=(entry(ANN, "ready"),))
    named(story, subject=OTHER)
    story("follow", None, 200, name="latest", seen=(entry(OTHER, "ready"),))
    story("names", None, 200, names=(("latest", IDS[OTHER]),))
    story("unpoint", None, 204, name="latest")
    story("names", None, 200)
    story("unpoint", None, 404, name="latest")
    assert story.findings == []
    story("names", None, 200, names=(("latest", IDS[OTHER]),))
    assert story.rules == ["came back"]


def test_a_name_that_is_lost_or_goes_back(story: Story) -> None:
    story.upload()
    story.upload(OTHER)
    named(story)
    named(story, subject=OTHER)
    story("names", None, 200)
    assert story.rules == ["lost"]
    story.history.operations.pop()
    story("follow", None, 200, name="latest", seen=(entry(ANN, "ready"),))
    assert story.rules == ["order"]


def test_a_change_of_a_name_without_an_answer_is_done_or_not(story: Story) -> None:
    story.upload()
    named(story, None)
    story("unpoint", None, 503, name="latest")
    for names in ((), (("latest", IDS[ANN]),), ()):
        story("names", None, 200, names=names)
    assert story.findings == []
    story.end()
    story("names", None, 200, names=(("latest", IDS[ANN]),))
    assert story.rules == ["came back"]


def test_what_a_name_shows_of_a_surface_is_in_its_order(story: Story) -> None:
    story.upload()
    named(story)
    story.look()
    story("fetch", ANN, 200, sha256="container of one of ann", named="container of one of ann")
    story("follow", None, 200, name="latest", seen=(entry(ANN, "queued"),))
    assert story.rules == ["went back"]


def test_a_name_is_restored_as_it_was_during_the_backup(story: Story) -> None:
    story.upload()
    story.upload(OTHER)
    named(story)
    story.mark("backup begins")
    story.mark("backup ends")
    named(story, subject=OTHER)
    story.end()
    story.mark("restored")
    story("names", None, 200, names=(("latest", IDS[ANN]),))
    assert story.findings == []
    story.history.operations.pop()
    story("names", None, 200, names=(("latest", IDS[OTHER]),))
    assert story.rules == ["order"]


def test_nothing_is_restored_without_a_backup(story: Story) -> None:
    story.upload()
    story.mark("restored")
    with pytest.raises(ValueError, match="expected a backup"):
        check(story.history)


def test_what_was_found_on_the_way(story: Story) -> None:
    story.history.found("start", "expected a server that refuses, got one that starts")
    assert [str(finding) for finding in story.findings] == [
        "start: expected a server that refuses, got one that starts"
    ]


def test_what_was_never_answered_happened_before_its_server_ended(story: Story) -> None:
    story.upload()
    story("delete", ANN)
    story.end()
    story.look(state=None, at=(11, 12))
    assert story.findings == []


def test_what_a_server_was_asked_after_its_end_never_happened(story: Story) -> None:
    story.upload()
    story.end()
    story("delete", ANN)
    story.look(state=None)
    assert story.rules == ["lost"]


def test_what_was_never_answered_may_come_in_any_order(story: Story) -> None:
    story("delete", ANN)
    story("upload", ANN)
    story.look(state="queued")
    story.look(state=None)
    assert story.findings == []


def test_a_server_that_is_busy_says_nothing_of_a_surface(story: Story) -> None:
    story.upload()
    story.look()
    story("fetch", ANN, 503, code="busy")
    story("delete", ANN, 503, code="restarting")
    story.look(state=None)
    story("upload", ANN, 503, code="restarting")
    story.look(state="queued")
    assert story.findings == []


def test_values_of_what_is_not_ready(story: Story) -> None:
    story.upload()
    story("values", ANN, 200, "queued")
    story("values", ANN, 409)
    assert story.findings == []


def test_ready_without_a_container(story: Story) -> None:
    story.upload()
    story("look", ANN, 200, seen=(Seen(IDS[ANN], "ready", ANN.name),))
    assert story.rules == ["state"]


def test_a_list_may_show_what_nobody_was_told_of(story: Story) -> None:
    story("upload", ANN)
    story.listed(entry(ANN, "queued"))
    assert story.findings == []


@pytest.mark.parametrize("state", ["ready", None])
def test_an_upload_that_is_answered_after_the_backup_during_which_it_came(story: Story, state: str | None) -> None:
    story.mark("backup begins")
    story.upload(at=(1.5, 10))
    story.mark("backup ends")
    story.history.marks[-1] = replace(story.history.marks[-1], moment=5)
    story.end()
    story.mark("restored")
    story.look(state=state)
    assert story.findings == []


def test_of_two_backups_the_last_one_is_restored(story: Story) -> None:
    story.mark("backup begins")
    story.mark("backup ends")
    backup(story)
    story.end()
    story.mark("restored")
    story.look(state=None)
    assert story.rules == ["lost"]


def test_a_server_that_follows_may_be_late_for_so_long(story: Story) -> None:
    story.history.lag = 5.0
    story.upload()
    story.look(state=None, at=(3, 4), server="reader")
    story.look(at=(4, 5), server="reader")
    story.look(state=None, at=(6, 7), server="reader")  # the upload was asked for at 1, and answered at 2
    assert story.findings == []
    story.look(state=None, at=(7.5, 8), server="reader")
    assert story.rules == ["lost"]


def test_a_deleted_surface_that_a_server_shows_for_too_long(story: Story) -> None:
    story.history.lag = 5.0
    story.upload()
    story("delete", ANN, 204)  # from 3 to 4
    story.look(at=(8, 9), server="reader")
    story.listed()
    assert story.findings == []
    story.look(at=(9.5, 10), server="reader")
    assert story.rules == ["came back"]


def test_what_failed_explains_that_a_server_is_later(story: Story) -> None:
    story.history.lag = 5.0
    story.upload()
    story.look(state=None, at=(20, 21), server="reader")
    assert story.rules == ["lost"]
    story.history.trouble(Span(3, 16))
    assert story.findings == []
    story.look(state=None, at=(21.5, 22), server="reader")
    assert story.rules == ["lost"]


def test_what_the_server_that_writes_acknowledges_is_never_late(story: Story) -> None:
    story.history.lag = 5.0
    story.upload(state="ready")
    story.look(state="queued")
    assert story.findings == []
    story.upload(state="queued")
    assert story.rules == ["went back"]


def test_names_may_be_late_too(story: Story) -> None:
    story.history.lag = 5.0
    story.upload()
    story("point", ANN, 201, name="latest")  # from 3 to 4
    story("names", None, 200, server="reader", at=(8, 9))
    assert story.findings == []
    story("names", None, 200, server="reader", at=(9.5, 10))
    assert story.rules == ["lost"]


def test_a_history_that_was_kept_is_judged_the_same(story: Story, tmp_path: Path) -> None:
    story.history.lag = 5.0
    story.history.trouble(Span(100, 101))
    story.history.waits(Span(2, 9, "second"))
    story.upload()
    story("delete", ANN, 204, server="second", at=(4, 5))
    story.look(at=(15, 16))
    story.history.write(tmp_path / "kept")
    kept = check(History.read(tmp_path / "kept"))
    assert [str(finding) for finding in kept] == [str(finding) for finding in story.findings]
    assert story.rules == ["not the writer", "came back"]


def test_each_trouble_before_another_one_explains_more(story: Story) -> None:
    story.history.lag = 5.0
    for span in (Span(10, 12), Span(16, 17), Span(40, 41)):
        story.history.trouble(span)
    assert story.history.since(story("look", ANN, 200, at=(21, 22))) == 5  # of the second, and so of the first
    assert story.history.since(story("look", ANN, 200, at=(23, 24))) == 18
    assert story.history.since(story("look", ANN, 200, at=(39, 40))) == 34


def test_it_is_told_what_is_being_judged(story: Story) -> None:
    story.upload()
    named(story)
    told: list[str] = []
    check(story.history, told.append)
    assert told == ["surface 1 of 1, 2 steps", "name 1 of 1, 1 steps"]


def test_a_server_that_waits_acknowledges_nothing(story: Story) -> None:
    story.history.waits(Span(2, 9, "second"))
    story("upload", ANN, 202, "queued", server="second", at=(1, 3))
    assert story.findings == []
    story("delete", ANN, 204, server="second", at=(4, 5))
    assert story.rules == ["not the writer"]


def test_a_server_that_waits_does_nothing_that_it_refuses(story: Story) -> None:
    story.history.waits(Span(3, 9, "second"))
    story.upload()
    story("delete", ANN, 503, server="second", at=(4, 5))
    story.look(state=None, at=(6, 7))
    assert story.rules == ["lost"]
    story.history.waiting.clear()
    assert story.findings == []
