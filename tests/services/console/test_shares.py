"""Shares of the users in the threads of the server: one user does not delay the others."""

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor

import httpx2
import pytest
from builders.console import image_record, session_cookie, web_server

from sonarpost.services.console.web import export_routes
from sonarpost.services.console.web.access import (
    MAX_THREADS,
    MAX_THREADS_OF_USER,
    MAX_WAITING_OF_USER,
    ApiError,
    ThreadShares,
)
from sonarpost.services.console.web.export_routes import _ExportQueue


def test_further_requests_of_a_user_wait_and_are_limited():
    async def check() -> None:
        shares, leave, running = ThreadShares(), threading.Event(), threading.Semaphore(0)

        def hold() -> None:
            running.release()
            assert leave.wait(120)

        held = [asyncio.create_task(shares.run("anna", hold)) for _ in range(MAX_THREADS_OF_USER + MAX_WAITING_OF_USER)]
        for _ in range(MAX_THREADS_OF_USER):
            assert await asyncio.to_thread(running.acquire, timeout=120)
        assert await shares.run("bo", str, 1) == "1"
        with pytest.raises(ApiError, match="too many requests"):
            await shares.run("anna", str, 1)
        assert not running.acquire(blocking=False)
        leave.set()
        await asyncio.gather(*held)
        assert len(shares._shares) == 0

    asyncio.run(check())


def test_a_user_with_many_requests_does_not_delay_the_others(console, monkeypatch):
    console.state.store_image(image_record())
    leave, entered = threading.Event(), threading.Semaphore(0)

    def hold():
        entered.release()
        assert leave.wait(120)
        return {}

    monkeypatch.setattr(console.state, "fleet_state", hold)
    with web_server(console) as server, ThreadPoolExecutor(MAX_THREADS * 3) as pool:
        tokens = {user: console.users.start_session(user).token for user in ("watch", "anna")}

        def get(user, path):
            cookies = {session_cookie(server.address): tokens[user]} if user else {}
            return httpx2.get(server.address + path, cookies=cookies, timeout=120).status_code

        held = [pool.submit(get, "watch", "api/fleet") for _ in range(MAX_THREADS * 3)]
        try:
            for _ in range(MAX_THREADS_OF_USER):
                assert entered.acquire(timeout=120)
            assert get("anna", "api/contacts") == 200
            assert get("", "login") == 200
            assert not any(one.done() for one in held)
        finally:
            leave.set()
        assert {one.result() for one in held} == {200}


def test_documents_are_written_in_turn(monkeypatch):
    monkeypatch.setattr(export_routes, "TURN_S", 0.0)
    queue = _ExportQueue()
    anna, bo = queue.enter("anna", "contacts.kmz"), queue.enter("bo", "contacts.html")
    turns = []
    for _ in range(3):
        for one in (anna, bo):
            turns.append((queue.wait_for_turn(anna), queue.wait_for_turn(bo)))
            queue.end_turn(one)
    assert turns == [(True, False), (False, True)] * 3
    queue.start_sending(anna)
    for _ in range(2):
        assert queue.wait_for_turn(bo)
        queue.end_turn(bo)
    queue.leave("anna")
    assert queue.wait_for_turn(bo)
