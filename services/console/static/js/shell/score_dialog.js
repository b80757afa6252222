// The score sheet: decisions of operators, and their score on contacts whose object is known.

import { age } from "../base/ages.js";
import { api } from "../base/api.js";
import { h, showDialog, toast } from "../base/dom.js";
import { DASH, bytes, duration, number, percent, symbol, time, verdict } from "../base/format.js";
import { emit, state } from "../base/state.js";
import { t } from "../texts.js";

/** A share with its counts and its 95 % interval. */
function shareText({ count, total, share, low, high }) {
  if (share === null) return DASH;
  return t("score.share", { share: percent(100 * share), count, total, low: percent(100 * low), high: percent(100 * high) });
}

const byteRange = (one) => (one.up_to_bytes === null
  ? t("score.above", { bytes: bytes(one.above_bytes) }) : t("score.range", { from: bytes(one.above_bytes + 1), to: bytes(one.up_to_bytes) }));

function scoreRow(name, one) {
  return h("tr", {}, h("th", { scope: "row", text: name }), h("td", { class: "number", text: number(one.decided) }),
    h("td", { class: "number", text: shareText(one.detected) }), h("td", { class: "number", text: shareText(one.false_alarms) }),
    h("td", { class: "number", text: number(one.unsure) }), h("td", { class: "number", text: duration(one.median_shown_s) }),
    h("td", { class: "number", text: bytes(one.median_bytes) }));
}

function scoreTable(operator) {
  const columns = ["decided", "pd", "false_alarms", "unsure", "time", "bytes"].map((name) => h("th", { scope: "col", class: "number", text: t(`score.${name}`) }));
  return [
    h("h3", { text: operator.operator }),
    h("table", { class: "score" },
      h("thead", {}, h("tr", {}, h("th", { scope: "col", text: t("score.images") }), columns)),
      h("tbody", {}, scoreRow(t("score.all"), operator), operator.by_bytes.map((one) => scoreRow(byteRange(one), one)))),
  ];
}

/**
 * Result of a verdict on a known object, as text and CSS class: correct, wrong, or the verdict if it is neither.
 * @param {{verdict: string, is_mine_like: boolean}} one
 * @returns {[string, string]}
 */
export function verdictResult(one) {
  if (!["mine_like", "not_mine_like"].includes(one.verdict)) return [verdict(one.verdict), ""];
  return (one.verdict === "mine_like") === one.is_mine_like ? [t("score.correct"), "good"] : [t("score.wrong"), "bad"];
}

function decisionRow(one, close) {
  const [result, tone] = verdictResult(one);
  return h("tr", {},
    h("td", {}, h("button", { type: "button", text: one.name, on: { click: () => { close(); emit("view", { name: "review" }); emit("select", { id: one.contact_id }); } } })),
    h("td", { text: one.operator }), h("td", { text: `${symbol(one.verdict)} ${verdict(one.verdict)}` }), h("td", { text: one.label }),
    h("td", { class: tone, text: result }),
    h("td", { class: "number", text: bytes(one.bytes_received) }), h("td", { class: "number", text: time(one.decided_utc_s) }));
}

/** Verdicts of each operator on all contacts, with the time to the first verdict on a contact. */
function watchTable(watch) {
  const heads = ["operator", "verdicts", "first_verdict", "decided_at"].map((name) => h("th", { scope: "col", text: t(`score.${name}`) }));
  const rows = watch.map((one) => h("tr", {}, h("th", { scope: "row", text: one.operator }),
    h("td", { text: Object.entries(one.verdicts).map(([name, count]) => `${count} ${verdict(name)}`).join(", ") }),
    h("td", { class: "number", text: duration(one.median_s) }), h("td", { class: "number", text: age(one.time_utc_s) })));
  return [h("h3", { text: t("score.watch") }), h("table", { class: "score" }, h("thead", {}, h("tr", {}, heads)), h("tbody", {}, rows))];
}

/** Show the decisions of all operators, and the score of the user; to an expert, those of all operators. */
export async function openScoreDialog() {
  let sheet;
  try {
    sheet = await api.score();
  } catch (error) {
    toast(error.message, { bad: true });
    return;
  }
  const close = () => /** @type {HTMLDialogElement | null} */ (document.querySelector("dialog[open]"))?.close();
  const heads = ["contact", "operator", "verdict", "object", "result", "bytes", "decided_at"].map((name) => h("th", { scope: "col", text: t(`score.${name}`) }));
  const scored = sheet.operators.length ? [
    h("p", { text: t("score.intro") }), ...sheet.operators.flatMap(scoreTable),
    h("h3", { text: t("score.decisions") }),
    h("table", { class: "score" }, h("thead", {}, h("tr", {}, heads)), h("tbody", {}, sheet.decisions.map((one) => decisionRow(one, close)))),
  ] : state.info.known_objects ? [h("p", { text: t("score.empty") })] : [];
  const watch = sheet.watch.length ? watchTable(sheet.watch) : [h("p", { text: t("score.no_decision") })];
  await showDialog(t("score.title"), [...watch, ...scored]);
}
