// The table of costs of all requests about a contact, with the reasons of those that are not possible.

import { api } from "../base/api.js";
import { h, showDialog, toast } from "../base/dom.js";
import { DASH, bytes, duration, requestKind } from "../base/format.js";
import { emit, state } from "../base/state.js";
import { t } from "../texts.js";

const COLUMNS = ["request", "airtime", "bytes", "queue", "basis"];

function costRow(cost, contact, checked) {
  const usable = cost.available && state.session.may.request;
  const reason = cost.available ? (usable ? cost.basis : t("request_dialog.role")) : t(`request_dialog.reason.${cost.reason_code}`, { vehicle: contact.vehicle_id, codec: contact.codec });
  const value = (text) => (cost.available ? text : DASH);
  return h("tr", { class: usable ? "" : "muted" },
    h("td", {}, h("label", {}, h("input", { type: "radio", name: "kind", value: cost.kind, disabled: !usable, checked }), ` ${requestKind(cost.kind)}: ${t(`request_dialog.${cost.kind}`)}`)),
    h("td", { class: "number" }, h("b", { text: value(duration(cost.airtime_s)) })),
    h("td", { class: "number", text: value(bytes(cost.bytes)) }),
    h("td", { class: "number", text: value(duration(cost.wait_s)) }),
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
    h("thead", {}, h("tr", {}, COLUMNS.map((name) => h("th", { scope: "col", text: t(`request_dialog.column.${name}`) })))),
    h("tbody", {}, costs.map((cost) => costRow(cost, contact, cost === usable[0]))));
  const action = await showDialog(t("request_dialog.title", { name: contact.name }), [
    h("p", { text: t("request_dialog.airtime_note") }), table,
  ], [{ label: t("request_buttons.send"), value: "send", primary: true, disabled: usable.length === 0 }, { label: t("request_buttons.cancel"), value: null }]);
  const kind = table.querySelector("input:checked")?.value;
  if (action !== "send" || !kind) return;
  try {
    await api.request(contact.id, { kind, airtime_s: costs.find((cost) => cost.kind === kind).airtime_s });
  } catch (error) {
    toast(error.message, { bad: true });
  }
  emit("changed", { id: contact.id });
}
