// The score sheet: decisions of operators on contacts whose object is known.

import { api } from "../base/api.js";
import { h, showDialog, toast } from "../base/dom.js";
import { DASH, bytes, duration, percent, symbol, time, verdict } from "../base/format.js";
import { emit } from "../base/state.js";
import { t } from "../texts.js";

/** A share with its counts and its 95 % interval. */
function shareText({ count, total, share, low, high }) {
  if (share === null) return DASH;
  return t("score.share", { share: percent(100 * share), count, total, low: percent(100 * low), high: percent(100 * high) });
}

const byteRange = (one) => (one.up_to_bytes === null
  ? t("score.above", { bytes: bytes(one.above_bytes) }) : t("score.range", { from: bytes(one.above_bytes + 1), to: bytes(one.up_to_bytes) }));

function scoreRow(name, one) {
  return h("tr", {}, h("th", { scope: "row", text: name }), h("td", { class: "number", text: String(one.decided) }),
    h("td", { class: "number", text: shareText(one.detected) }), h("td", { class: "number", text: shareText(one.false_alarms) }),
    h("td", { class: "number", text: String(one.unsure) }), h("td", { class: "number", text: duration(one.median_shown_s) }),
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

/** Whether a verdict agrees with the object; null for `unsure`. */
export const isCorrect = (one) => (one.verdict === "unsure" ? null : (one.verdict === "mine_like") === one.is_mine_like);

function decisionRow(one, close) {
  const correct = isCorrect(one);
  const result = correct === null ? t("score.undecided") : correct ? t("score.correct") : t("score.wrong");
  return h("tr", {},
    h("td", {}, h("button", { type: "button", text: one.name, on: { click: () => { close(); emit("view", { name: "review" }); emit("select", { id: one.contact_id }); } } })),
    h("td", { text: one.operator }), h("td", { text: `${symbol(one.verdict)} ${verdict(one.verdict)}` }), h("td", { text: one.label }),
    h("td", { class: correct === null ? "" : correct ? "good" : "bad", text: result }),
    h("td", { class: "number", text: bytes(one.bytes_received) }), h("td", { class: "number", text: time(one.decided_utc_s) }));
}

/** Show the score of the user, or of all operators to an expert. */
export async function openScoreDialog() {
  let sheet;
  try {
    sheet = await api.score();
  } catch (error) {
    toast(error.message, { bad: true });
    return;
  }
  const close = () => document.querySelector("dialog[open]")?.close();
  const heads = ["contact", "operator", "verdict", "object", "result", "bytes", "decided_at"].map((name) => h("th", { scope: "col", text: t(`score.${name}`) }));
  await showDialog(t("score.title"), sheet.operators.length ? [
    h("p", { text: t("score.intro") }), ...sheet.operators.flatMap(scoreTable),
    h("h3", { text: t("score.decisions") }),
    h("table", { class: "score" }, h("thead", {}, h("tr", {}, heads)), h("tbody", {}, sheet.decisions.map((one) => decisionRow(one, close)))),
  ] : [h("p", { text: t("score.empty") })], [{ label: t("score.close"), value: null, primary: true }]);
}
