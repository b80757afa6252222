"""Who acts, and what they may."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

Role = Literal["observer", "operator", "expert"]
Side = Literal["vessel", "shore"]
Act = Literal["decide", "measure", "request", "advise"]

ROLES: Final[tuple[Role, ...]] = ("observer", "operator", "expert")


@dataclass(frozen=True, slots=True)
class Actor:
    """Somebody who is logged in.

    Attributes:
        user: Name.
        role: Of the user.
        address: From where.
    """

    user: str
    role: Role
    address: str

    def may(self, act: Act, side: Side) -> bool:
        """Tell whether this person may do something on this side of the water.

        Decisions are made where the vehicle can be told at once: on a vessel. Ashore experts advise and ask.
        """
        if act == "advise":
            return side == "shore" and self.role == "expert"
        if act == "decide":
            return side == "vessel" and self.role != "observer"
        if act == "request" and side == "shore":
            return self.role == "expert"
        return self.role != "observer"
