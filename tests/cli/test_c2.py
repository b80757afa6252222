"""`sonarpost c2`: live lines, tables, copies, exports, and commands and comments for a vessel."""

import json
import signal
import subprocess
import sys
import threading

import pytest
import zenoh
from builders.common import eventually, free_port, publish_once, running
from builders.records import decision_record, reconstructed_image
from builders.shore import Site
from builders.store_steps import queued_items

from sonarpost import keys, wire
from sonarpost.bus.session import router_config
from sonarpost.cli.c2.stored import RecordFilter, join_decisions, select_images, time_of
from sonarpost.cli.main import main
from sonarpost.cli.shared import printable
from sonarpost.errors import ConfigError
from sonarpost.export.formats import exporters
from sonarpost.messages import Comment, Contact, Pixels, TaskingState
from sonarpost.services.c2.archive import Archive
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service

FIRST_S = 1_700_000_000.0


def image(image_id="AAAA", version=1, vehicle="uuv-1", vessel="vessel-1", first_frame_utc_s=FIRST_S):
    pixels = Pixels(height_px=20, width_px=30, bits=8, data=bytes([version]) * 600)
    return reconstructed_image(
        pixels,
        vessel_id=vessel,
        vehicle_id=vehicle,
        image_id=image_id,
        version=version,
        contact=Contact(contact_id=f"{vehicle}/{image_id}", vehicle_id=vehicle, lat_deg=56.4, lon_deg=-5.6),
        first_frame_utc_s=first_frame_utc_s,
        last_frame_utc_s=first_frame_utc_s + 1,
    )


def decision(decision_id="d1", decided_utc_s=FIRST_S + 60, **changes):
    return decision_record(decision_id, decided_utc_s=decided_utc_s, **changes)


@pytest.fixture
def out(tmp_path):
    """Folder of c2: three images, one of them in two versions, and a decision."""
    folder = tmp_path / "out"
    archive = Archive(C2Config(out_dir=folder))
    last = image("CCCC", vehicle="uuv-2", vessel="vessel-2")
    for record in (image("AAAA", 1), image("AAAA", 2), image("BBBB"), last):
        archive.store_image(record, 5.0)
        archive.flush()
    archive.store_decision(decision())
    archive.flush()
    archive.close()
    return folder


def ls(capsys, out, *options):
    assert main(["c2", "ls", "--archive", str(out), "--json", *options]) == 0
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_ls_lists_the_newest_version_with_its_decision(capsys, out):
    rows = ls(capsys, out)
    assert [(r["image_id"], r["version"], (r["decision"] or {}).get("verdict")) for r in rows] == [
        ("AAAA", 2, "mine_like"),
        ("BBBB", 1, None),
        ("CCCC", 1, None),
    ]


def test_ls_filters(capsys, out):
    for options, expected in (
        ("--vessel vessel-2", ["CCCC"]),
        ("--vehicle uuv-1", ["AAAA", "BBBB"]),
        ("--undecided", ["BBBB", "CCCC"]),
        ("--all-versions --vessel vessel-1", ["AAAA", "AAAA", "BBBB"]),
        ("--since 2099-01-01", []),
        ("--since 2023-11-14T22:13:20", ["AAAA", "BBBB", "CCCC"]),
        ("--until 2023-11-14T22:13:20", []),
        ("--since 1h", []),
    ):
        assert sorted(r["image_id"] for r in ls(capsys, out, *options.split())) == expected, options


def test_ls_prints_a_table(capsys, out):
    assert main(["c2", "ls", "--archive", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "image" in lines[0]
    [line] = [line for line in lines if "uuv-1/AAAA" in line]
    for part in ("vessel-1", "2023-11-14 22:13:20", "56.40000 -5.60000", "mine_like", "op", "0 %"):
        assert part in line
    assert lines[-1] == "3 images"


def test_ls_states_class_and_probabilities(capsys, tmp_path):
    archive = Archive(C2Config(out_dir=tmp_path))
    fields = {"atd_class": "mine_like", "atd_confidence": 1.5, "p_mine_like": 0.85, "p_other_object": 0.1}
    for image_id, changes in (("AAAA", fields), ("BBBB", {"atd_class": "structure"})):
        record = image(image_id)
        archive.store_image(record.model_copy(update={"contact": record.contact.model_copy(update=changes)}), 5.0)
    archive.flush()
    archive.close()
    rows = {row["image_id"]: row["contact"] for row in ls(capsys, tmp_path)}
    assert {name: rows["AAAA"][name] for name in fields} == fields
    assert [rows["BBBB"][name] for name in fields if name != "atd_confidence"] == ["structure", None, None]
    assert main(["c2", "ls", "--archive", str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    [line] = [line for line in lines if "uuv-1/AAAA" in line]
    assert "mine_like 1.50, mine-like 85 %, other object 10 %, seabed 5 %" in line
    [line] = [line for line in lines if "uuv-1/BBBB" in line]
    assert "structure" in line
    assert "seabed" not in line
    assert main(["c2", "get", "uuv-1/AAAA", "--archive", str(tmp_path), "--out", str(tmp_path / "copy")]) == 0
    [side_car] = (tmp_path / "copy").glob("*.json")
    contact = json.loads(side_car.read_text())["contact"]
    assert {name: contact[name] for name in fields} == fields


def test_decision_matches_the_image_received_before_it(tmp_path):
    """A vehicle with a new store uses the same image identifiers again."""
    archive = Archive(C2Config(out_dir=tmp_path))
    archive.store_image(image("AAAA", first_frame_utc_s=1000.0), 5.0)
    archive.flush()
    archive.store_image(image("AAAA", first_frame_utc_s=2000.0), 5.0)
    archive.flush()
    for record in (decision("d1", decided_utc_s=1500.0), decision("d2", decided_utc_s=2500.0, verdict="unsure")):
        archive.store_decision(record)
        archive.flush()
    rows = join_decisions(archive.index().images(), archive.index().decisions())
    archive.close()
    assert [(r.image.first_frame_utc_s, r.decision and r.decision.decision_id) for r in rows] == [
        (1000.0, "d1"),
        (2000.0, "d2"),
    ]
    assert len(select_images(rows, RecordFilter())) == 2


def test_get_copies_the_newest_version(capsys, out, tmp_path):
    assert main(["c2", "get", "uuv-1/AAAA", "--archive", str(out), "--out", str(tmp_path / "here")]) == 0
    names = sorted(p.name for p in (tmp_path / "here").iterdir())
    assert names == [f"uuv-1_20231114T221320Z_AAAA_v2.{kind}" for kind in ("json", "png", "tiff")]
    for name in names:
        assert (tmp_path / "here" / name).read_bytes() == (out / "vessel-1" / name).read_bytes()
    assert main(["c2", "get", "uuv-1/ZZZZ", "--archive", str(out)]) == 2
    assert "an image that `sonarpost c2 ls` shows" in capsys.readouterr().err


def test_get_copies_nothing_if_a_file_is_unreadable(capsys, out, tmp_path):
    next(out.glob("vessel-1/*AAAA_v2.png")).unlink()
    assert main(["c2", "get", "uuv-1/AAAA", "--archive", str(out), "--out", str(tmp_path / "here")]) == 2
    assert "a readable file of c2" in capsys.readouterr().err
    assert not (tmp_path / "here").exists()


def test_export_writes_all_formats_and_marks_images_as_exported(capsys, out, tmp_path):
    files = {name: tmp_path / "new" / f"contacts.{name}" for name in exporters().names()}
    options = [part for path in files.values() for part in ("--out", str(path))]
    assert main(["c2", "export", "--archive", str(out), "--vessel", "vessel-1", *options]) == 0
    assert len(json.loads(files["geojson"].read_text())["features"]) == 2
    assert files["kmz"].read_bytes().startswith(b"PK")
    assert files["gpkg"].read_bytes().startswith(b"SQLite format 3")
    assert all(path.stat().st_size for path in files.values())
    assert "2 contacts, 0 of them without a position" in capsys.readouterr().out
    exported = {r["image_id"]: r["exported_utc_s"] is not None for r in ls(capsys, out, "--all-versions")}
    assert exported == {"AAAA": True, "BBBB": True, "CCCC": False}


def test_export_to_a_file_of_unknown_format_is_an_error(capsys, out, tmp_path):
    assert main(["c2", "export", "--archive", str(out), "--out", str(tmp_path / "contacts.shp")]) == 2
    expected = ".csv, .geojson, .gpkg, .kml, .kmz"
    assert expected in capsys.readouterr().err


def test_export_needs_an_output_and_reports_rejected_files(capsys, out, tmp_path):
    with pytest.raises(SystemExit):
        main(["c2", "export", "--archive", str(out)])
    assert "required: --out" in capsys.readouterr().err
    (out / "vessel-1" / "broken.json").write_text("{")
    assert main(["c2", "export", "--archive", str(out), "--out", str(tmp_path / "c.csv")]) == 1
    assert "rejected: " in capsys.readouterr().err


@pytest.fixture
def c2(platform, tmp_path):
    with running(C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "live"))) as service:
        yield service


def test_comment_is_stored_by_c2_when_the_command_ends(capsys, c2, router, tmp_path):
    arguments = ["c2", "comment", "uuv-1/AAAA", "--vessel", "vessel-1", "--version", "2", "--verdict", "mine_like"]
    arguments += ["--confidence", "0.5", "--class", "sphere", "--remark", "look", "--author", "ann", "--id", "a-1"]
    assert main([*arguments, "--router", router]) == 0
    assert "comment a-1 for vessel-1 accepted" in capsys.readouterr().out
    eventually(lambda: c2.gauges()["waiting_for_vessels"] == 1)
    [item] = queued_items(c2.store, "relay@vessel-1", 9)
    comment = wire.decode(Comment, item.payload, item.key)
    assert item.key == keys.comment("vessel-1")
    assert (comment.image_id, comment.image_version, comment.verdict, comment.author) == ("AAAA", 2, "mine_like", "ann")
    listing = ["c2", "ls", "--tasking", "--json", "--archive", str(tmp_path / "live")]
    eventually(lambda: main(listing) == 0 and '"state": "waiting"' in capsys.readouterr().out)
    # Another record with the same identifier is rejected.
    assert main([*arguments[:-4], "--author", "ann", "--remark", "other", "--id", "a-1", "--router", router]) == 2
    assert "an identifier that no other record for this vessel has" in capsys.readouterr().err


def test_commands_are_sent_before_a_comment(capsys, c2, router):
    send = [["comment"], *(["command", "--kind", kind] for kind in ("refine", "expand"))]
    for action, *options in send:
        assert main(["c2", action, "uuv-1/AAAA", "--vessel", "vessel-1", "--router", router, *options]) == 0
    eventually(lambda: c2.gauges()["waiting_for_vessels"] == 3)
    assert [item.key for item in queued_items(c2.store, "relay@vessel-1", 9)] == [
        keys.command("vessel-1", "refine"),
        keys.command("vessel-1", "expand"),
        keys.comment("vessel-1"),
    ]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["comment", "uuv-1", "--vessel", "vessel-1"], "image_id"),
        (["comment", "uuv-1/aaaa", "--vessel", "vessel-1"], "image_id"),
        (["comment", "uuv-1/AAAA", "--vessel", "vessel-1", "--confidence", "2"], "confidence"),
        (["command", "uuv-1", "--vessel", "vessel-1", "--kind", "revisit"], "the position to revisit"),
        (["command", "uuv-1", "--vessel", "vessel-1", "--kind", "refine"], "the image to refine"),
    ],
)
def test_invalid_record_is_rejected_before_sending(arguments, text, capsys):
    assert main(["c2", *arguments]) == 2
    assert text in capsys.readouterr().err


def test_unreachable_c2_or_router_is_an_error(capsys, router):
    common = ["c2", "comment", "uuv-1/AAAA", "--vessel", "vessel-1", "--timeout", "0.5"]
    assert main([*common, "--router", router]) == 2
    assert "not delivered to c2 within 0.5 s: no reply" in capsys.readouterr().err
    assert main([*common, "--router", f"tcp/127.0.0.1:{free_port()}"]) == 2
    assert "no router answered within 0.5 s" in capsys.readouterr().err


def test_watch_prints_lines_across_router_restarts_until_ctrl_c():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    hub = zenoh.open(router_config([endpoint]))
    printed, errors = [], []
    command = [sys.executable, "-um", "sonarpost.cli.main", "c2", "watch", "--router", endpoint]
    site = Site(hub, image("0000"))

    def first_record_is_printed():
        site.accept(image())
        return bool(printed)

    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        for stream, lines in ((process.stdout, printed), (process.stderr, errors)):
            threading.Thread(target=lambda s=stream, to=lines: to.extend(iter(s.readline, "")), daemon=True).start()
        try:
            eventually(lambda: any("watching shore" in line for line in errors))
            eventually(first_record_is_printed)
            publish_once(hub, keys.shore_image("vessel-1"), b"rubbish")
            eventually(lambda: any("Invalid record ignored" in line for line in errors))
            site.accept(decision(remark="two\nlines \x1b[31m"))
            state = {"kind": "comment", "record_id": "a", "state": "refused", "reason": "no", "changed_utc_s": 1}
            site.accept(TaskingState(vessel_id="vessel-1", **state))
            eventually(lambda: all(kind in "".join(printed) for kind in ("decision", "comment")))
            assert "uuv-1/0000" not in "".join(printed)  # accepted before
            assert "vessel-1  image     uuv-1/AAAA v1  30 × 20 px, complete, at 56.40000 -5.60000" in "".join(printed)
            assert "decision  uuv-1/AAAA v1  mine_like two?lines ?[31m (op)\n" in "".join(printed)
            assert "comment   a  refused: no\n" in "".join(printed)
            hub.close()
            eventually(lambda: any("router not reached" in line for line in errors))
            hub = zenoh.open(router_config([endpoint]))
            eventually(lambda: any("router reconnected" in line for line in errors))
            number = len(site._accepted)
            site = Site(hub, *[image()] * number)
            site.accept(image("ZZZZ"))
            eventually(lambda: any("uuv-1/ZZZZ" in line for line in printed))
            process.send_signal(signal.SIGINT)
            assert process.wait() == 0
            assert not any("Traceback" in line for line in errors)
        finally:
            process.kill()
            hub.close()


def test_time_forms():
    for text, ago_s in (("90m", 5400), ("2h", 7200), ("1.5d", 129600)):
        assert time_of("--since", text, 1e6) == 1e6 - ago_s
    for text in ("", "yesterday", "2h30m", "-1h", "12"):
        with pytest.raises(ConfigError, match="--until"):
            time_of("--until", text)


def test_control_characters_are_not_printed():
    assert printable("a\x1b[2Jb\n\u202ec") == "a?[2Jb??c"


# The folder without --archive


@pytest.fixture
def elsewhere(out, tmp_path, monkeypatch):
    """An empty current folder, on a host whose /etc/sonarpost/shore.toml names the fixture's folder."""
    folder = tmp_path / "cwd"
    folder.mkdir()
    monkeypatch.chdir(folder)
    config = tmp_path / "shore.toml"
    config.write_text(f'[platform]\nid = "shore-1"\n[c2]\nout_dir = "{out}"\n')
    monkeypatch.setattr("sonarpost.cli.c2.stored.SHORE_CONFIG", config)
    return folder


def test_folder_comes_from_the_configuration_of_the_host(elsewhere, out, tmp_path, capsys):
    for options in ([], ["--config", str(tmp_path / "shore.toml")]):
        assert main(["c2", "ls", *options]) == 0
        printed = capsys.readouterr()
        assert printed.out.endswith("3 images\n")
        assert printed.err == f"sonarpost c2: folder {out}\n"
    assert main(["c2", "get", "uuv-1/AAAA", "--out", "here"]) == 0
    assert main(["c2", "export", "--out", "c.csv", "--vessel", "vessel-1"]) == 0
    assert len(list(elsewhere.glob("here/*"))) == 3
    assert (elsewhere / "c.csv").is_file()


def test_folder_of_a_demo_in_the_current_folder_comes_first(elsewhere, tmp_path, capsys):
    archive = Archive(C2Config(out_dir=elsewhere / "demo-out" / "shore" / "images"))
    archive.store_image(image("CCCC"), 5.0)
    archive.flush()
    archive.close()
    assert main(["c2", "ls"]) == 0
    printed = capsys.readouterr()
    assert printed.out.endswith("1 images\n")
    assert printed.err == "sonarpost c2: folder demo-out/shore/images\n"
    assert main(["c2", "ls", "--config", str(tmp_path / "shore.toml")]) == 0
    assert capsys.readouterr().out.endswith("3 images\n")


def test_folder_is_out_if_nothing_names_one(elsewhere, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("sonarpost.cli.c2.stored.SHORE_CONFIG", tmp_path / "absent.toml")
    assert main(["c2", "ls"]) == 2
    assert "out/archive.db: got 'no such file', expected the archive" in capsys.readouterr().err
    assert main(["c2", "ls", "--config", str(tmp_path / "absent.toml")]) == 2
    assert "absent.toml" in capsys.readouterr().err
