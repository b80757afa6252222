"""Start of the page: the contact that the address names is displayed."""

from __future__ import annotations

from builders.console import image_record


def test_address_with_a_contact_displays_this_contact(served):
    for number in range(6):
        served.state.store_image(image_record(f"000{number}", seed=number, position=(56.0 + 0.001 * number, -5.0)))
    from sonarpost.services.console.store.contacts import ContactFilter

    ids = {row["image_id"]: row["id"] for row in served.state.list_contacts(ContactFilter())["items"]}
    visit = served.visit(path="")
    visit.wait_for_contact("0005")
    visit.page.goto(f"{served.address}#{ids['0002']}")
    visit.page.reload()
    visit.wait_for_contact("0002")
    visit.page.wait_for_timeout(500)
    visit.wait_for_contact("0002")
    assert visit.page.get_attribute('.row[aria-selected="true"]', "data-id") == ids["0002"]
