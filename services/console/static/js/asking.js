// Asking for more: nothing goes into the water before its cost was on the screen.

import { api } from "./api.js";
import { ask, h, toast } from "./dom.js";
import { bytes, duration } from "./format.js";
import { state, tell } from "./state.js";

const WHAT = {
  refine: "refine: more detail of the whole picture", resend: "resend: what was lost on the way", wider: "wider: more seabed around it",
  revisit: "revisit: pass the place again",
};

function row(cost, index) {
  const usable = cost.available && state.session.may.request;
  const reason = cost.available ? (usable ? cost.basis : "your role may not ask") : cost.reason;
  return h("tr", { class: usable ? "" : "muted" },
    h("td", {}, h("label", {}, h("input", { type: "radio", name: "kind", value: cost.kind, disabled: !usable, checked: usable && index === 0 }), ` ${WHAT[cost.kind] ?? cost.kind}`)),
    h("td", { class: "number" }, h("b", { text: cost.available ? duration(cost.airtime_s) : "–" })),
    h("td", { class: "number", text: cost.available ? bytes(cost.bytes) : "–" }),
    h("td", { class: "number", text: cost.available ? duration(cost.wait_s) : "–" }),
    h("td", { class: "muted", text: reason }));
}

/** Show what asking for more about a contact costs, and send what is chosen. */
export async function askForMore(contact) {
  let costs;
  try {
    ({ costs } = await api.costs(contact.id));
  } catch (error) {
    toast(error.message, { bad: true });
    return;
  }
  const usable = costs.filter((cost) => cost.available && state.session.may.request);
  const table = h("table", { class: "costs" },
    h("thead", {}, h("tr", {}, ["ask for", "air time", "bytes", "waits before it", "how this is known"].map((name) => h("th", { scope: "col", text: name })))),
    h("tbody", {}, costs.map((cost) => row(cost, usable.indexOf(cost)))));
  const answer = await ask(`${contact.name}: ask for more`, [
    h("p", { text: "The air time is down and up together. While it goes, other pictures wait." }), table,
  ], [{ label: "Send the order", value: "send", primary: true, disabled: usable.length === 0 }, { label: "Cancel", value: null }], );
  const kind = table.querySelector("input:checked")?.value;
  if (answer !== "send" || !kind) return;
  const { airtime_s } = costs.find((cost) => cost.kind === kind);
  try {
    await api.request(contact.id, { kind, airtime_s });
    toast(`${contact.name}: asked for ${kind}, ≈ ${duration(airtime_s)} of air time`);
  } catch (error) {
    toast(error.message, { bad: true });
  }
  tell("changed", { id: contact.id });
}
