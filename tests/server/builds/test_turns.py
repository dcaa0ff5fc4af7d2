"""Turns: who is next, who gives up, and who is forgotten."""

from __future__ import annotations

import asyncio
from random import Random

from lodestream_server.access.turns import Place, Turns
from tests.server.helpers import PATIENCE


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


async def order_of(turns: Turns, clock: Clock, wants: list[str]) -> list[str]:
    """In which order callers have their turns who come one after the other, each for a second."""
    order: list[str] = []

    async def work(caller: str) -> None:
        async with turns.turn(caller):
            order.append(caller)
            await asyncio.sleep(0)
            clock.now += 1.0

    async with asyncio.timeout(PATIENCE), asyncio.TaskGroup() as group:
        for caller in wants:
            group.create_task(work(caller))
    return order


def test_fifty_of_one_caller_delay_anothers_first_by_one() -> None:
    clock = Clock()
    order = asyncio.run(order_of(Turns(1, 600.0, clock), clock, [*["anna"] * 50, "bert"]))
    assert order == ["anna", "bert", *["anna"] * 49]


def test_whoever_has_used_much_lately_comes_later_and_not_for_ever() -> None:
    async def compare(pause: float) -> list[str]:
        clock = Clock()
        turns = Turns(1, 600.0, clock)
        async with turns.turn("anna"):
            clock.now += 3600
        clock.now += pause
        async with turns.turn("bert"):
            clock.now += 20
            waiting = asyncio.create_task(order_of(turns, clock, ["anna", "bert"]))
            await asyncio.sleep(0.01)
        return await waiting

    assert asyncio.run(compare(0.0)) == ["bert", "anna"]
    assert asyncio.run(compare(7200.0)) == ["anna", "bert"]


def test_two_at_a_time_are_of_two_callers() -> None:
    async def crowd() -> None:
        turns, running, worst = Turns(2, 600.0), list[str](), 0

        async def work(caller: str) -> None:
            nonlocal worst
            async with turns.turn(caller):
                running.append(caller)
                if "bert" in waiting:
                    worst = max(worst, running.count("anna"))
                waiting.discard(caller)
                await asyncio.sleep(0.001)
                running.remove(caller)

        waiting: set[str] = set()
        async with asyncio.timeout(PATIENCE), asyncio.TaskGroup() as group:
            for _ in range(10):
                group.create_task(work("anna"))
            await asyncio.sleep(0)
            waiting.add("bert")
            group.create_task(work("bert"))
        assert not running
        assert worst <= 2
        assert (turns._free, turns._running, turns._waiting) == (2, {}, {})

    asyncio.run(crowd())


def test_whoever_has_fewer_turns_now_comes_first_even_if_it_has_used_more() -> None:
    async def crowd() -> list[str]:
        clock = Clock()
        turns, order = Turns(2, 600.0, clock), list[str]()

        async def work(caller: str) -> None:
            async with turns.turn(caller):
                order.append(caller)

        async with asyncio.timeout(PATIENCE), asyncio.TaskGroup() as group:
            async with turns.turn("bert"):
                clock.now += 20
            async with turns.turn("anna"):
                async with turns.turn("carl"):
                    for caller in ("anna", "bert"):
                        group.create_task(work(caller))
                        await asyncio.sleep(0)
                for _ in range(5):
                    await asyncio.sleep(0)
        return order

    assert asyncio.run(crowd()) == ["bert", "anna"]


def test_a_turn_is_charged_to_the_caller_in_whose_turn_the_task_came() -> None:
    async def share() -> dict[str, int]:
        clock = Clock()
        turns = Turns(1, 600.0, clock)
        async with turns.turn("bert"):
            clock.now += 100
        place = Place(turns)

        async def work() -> None:
            async with place.turn():
                clock.now += 10

        async with asyncio.timeout(PATIENCE), asyncio.TaskGroup() as group, turns.turn("zoe"):
            for caller in ("bert", "anna"):
                place.join(caller)
            group.create_task(work())
            await asyncio.sleep(0)
        return {caller: round(turns._use(caller, clock.now)) for caller in ("anna", "bert")}

    assert asyncio.run(share()) == {"anna": 10, "bert": 91}


def test_a_turn_that_nobody_takes_goes_to_the_next() -> None:
    async def crowd(seed: int) -> None:
        random, turns = Random(seed), Turns(2, 600.0)
        inside = most = 0

        async def work(caller: str) -> None:
            nonlocal inside, most
            async with turns.turn(caller, random.randrange(3)):
                inside += 1
                most = max(most, inside)
                try:
                    await asyncio.sleep(0)
                finally:
                    inside -= 1

        tasks = []
        for _ in range(60):
            tasks.append(asyncio.create_task(work(random.choice("abc"))))
            for _ in range(random.randrange(3)):
                await asyncio.sleep(0)
            if random.random() < 0.5:
                random.choice(tasks).cancel()
        async with asyncio.timeout(PATIENCE):
            await asyncio.gather(*tasks, return_exceptions=True)
        assert (inside, most) == (0, 2)
        async with asyncio.timeout(PATIENCE), turns.turn("a"), turns.turn("b"):
            pass
        assert turns._free == 2
        assert not turns._running

    for seed in range(50):
        asyncio.run(crowd(seed))


def test_callers_are_forgotten_in_the_end() -> None:
    async def many() -> Turns:
        turns = Turns(1, 600.0)
        for number in range(1500):
            async with turns.turn(f"address {number}"):
                pass
        return turns

    assert len(asyncio.run(many())._used) <= 1000


def test_whoever_comes_and_goes_stands_in_line_once() -> None:
    async def come_and_go() -> None:
        turns, order = Turns(1, 600.0), list[str]()
        places = {name: Place(turns) for name in ("first", "second")}

        async def work(name: str) -> None:
            async with places[name].turn():
                order.append(name)

        async with asyncio.timeout(PATIENCE), asyncio.TaskGroup() as group, turns.turn("zoe"):
            for name, place in places.items():
                place.join("anna")
                group.create_task(work(name))
            await asyncio.sleep(0)
            for _ in range(1000):
                places["second"].join("bert")
                places["first"].join("bert")
                places["first"].leave("bert")
            assert len(turns._waiting["bert"]) == 2
            # One that left is in nobody's way, and one that came back has a turn.
            places["first"].leave("anna")
            places["first"].join("bert")
        assert sorted(order) == ["first", "second"]
        assert (turns._free, turns._running, turns._waiting) == (1, {}, {})

    asyncio.run(come_and_go())


def test_whoever_was_passed_over_while_away_stands_in_line_again() -> None:
    async def come_back() -> bool:
        turns = Turns(1, 600.0)
        place, began = Place(turns), asyncio.Event()

        async def work() -> None:
            async with place.turn():
                began.set()

        async with turns.turn("zoe"):
            another = asyncio.create_task(turns.turn("anna").__aenter__())
            await asyncio.sleep(0)
            for caller in ("anna", "bert"):
                place.join(caller)
            working = asyncio.create_task(work())
            await asyncio.sleep(0)
            place.leave("bert")
        await another
        place.join("bert")
        place.leave("anna")
        turns._leave("anna")  # the other one ends
        for _ in range(5):
            await asyncio.sleep(0)
        working.cancel()
        return began.is_set()

    assert asyncio.run(come_back())


def test_tasks_of_a_caller_come_in_the_order_of_their_ranks() -> None:
    async def crowd() -> list[tuple[int, int]]:
        order: list[tuple[int, int]] = []
        turns = Turns(1, 600.0)

        async def work(rank: int, number: int) -> None:
            async with turns.turn("anna", rank):
                order.append((rank, number))

        async with asyncio.timeout(PATIENCE), asyncio.TaskGroup() as group, turns.turn("anna"):
            for number, rank in enumerate((2, 0, 1, 0)):
                group.create_task(work(rank, number))
            await asyncio.sleep(0)
            assert not order
        return order

    assert asyncio.run(crowd()) == [(0, 1), (0, 3), (1, 2), (2, 0)]


def test_what_a_caller_has_used_adds_up() -> None:
    async def crowd() -> list[str]:
        clock = Clock()
        turns = Turns(1, 600.0, clock)
        for caller, seconds in (("anna", 20), ("bert", 30), ("anna", 20)):
            async with turns.turn(caller):
                clock.now += seconds
        async with turns.turn("carl"):
            waiting = asyncio.create_task(order_of(turns, clock, ["anna", "bert"]))
            await asyncio.sleep(0.01)
        return await waiting

    assert asyncio.run(crowd()) == ["bert", "anna"]
