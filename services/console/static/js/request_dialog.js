// The dialog for requests to a vehicle. It shows the cost of each request before one is sent.

import { api } from "./api.js";
import { h, showDialog, toast } from "./dom.js";
import { bytes, duration, requestKind } from "./format.js";
import { emit, state } from "./state.js";

const DESCRIPTIONS = {
  refine: "more detail in the whole image", resend: "missing parts of the image", wider: "more seabed around the contact",
  revisit: "pass the position again", original: "the image without despeckling",
};

function costRow(cost, index) {
  const usable = cost.available && state.session.may.request;
  const reason = cost.available ? (usable ? cost.basis : "your role may not send requests") : cost.reason;
  return h("tr", { class: usable ? "" : "muted" },
    h("td", {}, h("label", {}, h("input", { type: "radio", name: "kind", value: cost.kind, disabled: !usable, checked: usable && index === 0 }), ` ${requestKind(cost.kind)}: ${DESCRIPTIONS[cost.kind] ?? ""}`)),
    h("td", { class: "number" }, h("b", { text: cost.available ? duration(cost.airtime_s) : "–" })),
    h("td", { class: "number", text: cost.available ? bytes(cost.bytes) : "–" }),
    h("td", { class: "number", text: cost.available ? duration(cost.wait_s) : "–" }),
    h("td", { class: "muted", text: reason }));
}

/** Show the costs of requests about a contact, and send the chosen one. */
export async function openRequestDialog(contact) {
  let costs;
  try {
    ({ costs } = await api.costs(contact.id));
  } catch (error) {
    toast(error.message, { bad: true });
    return;
  }
  const usable = costs.filter((cost) => cost.available && state.session.may.request);
  const table = h("table", { class: "costs" },
    h("thead", {}, h("tr", {}, ["request", "air time", "bytes", "queue before it", "basis of the estimate"].map((name) => h("th", { scope: "col", text: name })))),
    h("tbody", {}, costs.map((cost) => costRow(cost, usable.indexOf(cost)))));
  const action = await showDialog(`${contact.name}: request more data`, [
    h("p", { text: "The air time includes both directions. Other images wait during this time." }), table,
  ], [{ label: "Send request", value: "send", primary: true, disabled: usable.length === 0 }, { label: "Cancel", value: null }]);
  const kind = table.querySelector("input:checked")?.value;
  if (action !== "send" || !kind) return;
  const { airtime_s } = costs.find((cost) => cost.kind === kind);
  try {
    await api.request(contact.id, { kind, airtime_s });
    toast(`${contact.name}: ${requestKind(kind)} requested, ≈ ${duration(airtime_s)} of air time`);
  } catch (error) {
    toast(error.message, { bad: true });
  }
  emit("changed", { id: contact.id });
}
