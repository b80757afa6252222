"""Text in the form of CARIS contact files, and reports in the manner of APP-11."""

import re

from builders.exports import decision, export, image, mission, store
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.export.contacts import ContactSet, ExportContact, load_contacts
from sonarpost.export.live import LiveContacts


def caris_text(contacts):
    return export("caris.txt", contacts).decode()


def mine_report(contacts):
    return export("app11-like.txt", contacts).decode("ascii")


def one(**changes):
    live = LiveContacts()
    live.add(image("00A7"))
    found = live.add(decision("00A7", **changes))
    assert isinstance(found, ExportContact)
    return ContactSet((found,), (), ())


def test_caris_lines_have_one_form(tmp_path):
    assert caris_text(one(remark="a,b")) == (
        "0000,uuv-1   0367,0000,0367,10/12/2016,08:59:50.5,ATD,10/12/2016,09:10:01.2,A. ,0000,20.50,"
        "41.5251334,-70.6712456,uuv-1/00A7 mine_like a;b\n"
    )
    contacts = load_contacts(mission(tmp_path / "out"))
    rows = [line.split(",") for line in caris_text(contacts).splitlines()]
    assert [row[0] for row in rows] == [f"{n:04}" for n in range(len(contacts.located))]
    assert {len(row) for row in rows} == {15}
    assert [float(row[12]) for row in rows] == [round(c.position[0], 7) for c in contacts.located if c.position]
    assert all(len(row[1]) == 12 for row in rows)
    assert {row[11] for row in rows} == {"20.50", "-20.50"}


def test_mine_report():
    assert mine_report(one(mlo_class="moored mine", remark="look / again")) == (
        "NOTE/NOT CONFORMANT WITH APP-11. IN THE MANNER OF A MINE REPORT. BY SONARPOST//\n"
        "CONTACTS/1/WITHOUT POSITION/0//\n"
        "CONTACT/001/SONARPOST.VESSEL-1.UUV-1.20161012T090001Z.00A7/MILCO//\n"
        "POSITION/4131.508N-07040.275W/WGS84/4.5M//\n"
        "TIME/120859ZOCT2016//\n"
        "WATERDEPTH/15.8M//\n"
        "CLASS/MOORED MINE/UNKNOWN//\n"
        "DECIDED/A. OPERATOR/120910ZOCT2016//\n"
        "REMARK/LOOK   AGAIN//\n"
    )


def test_contacts_without_position_are_listed(tmp_path):
    contacts = load_contacts(store(tmp_path / "out", image(contact={"lat_deg": None, "depth_m": None})))
    text = mine_report(contacts)
    assert "POSITION/UNKNOWN/WGS84/" in text
    assert "WATERDEPTH/UNKNOWN//" in text
    assert caris_text(contacts) == ""


@given(st.text(max_size=80), st.text(min_size=1, max_size=40), st.text(max_size=40))
def test_free_text_cannot_add_fields_or_sets(remark, operator, mlo_class):
    contacts = one(remark=remark, operator=operator, mlo_class=mlo_class)
    [line] = caris_text(contacts).splitlines()
    assert len(line.split(",")) == 15
    report = mine_report(contacts)
    assert re.fullmatch(r"(?:[A-Z0-9]+(?:/[A-Z0-9 .,()?\-]*)+//\n)+", report)
    assert report.count("\n") == (9 if remark else 8)
