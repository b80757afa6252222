// Mission: contacts, area, air time, queue and decisions of each vehicle and in total, each value with its age.

import { age, since } from "../base/ages.js";
import { api } from "../base/api.js";
import { fill, h } from "../base/dom.js";
import { DASH, bytes, duration, percent, quantity, time, verdict } from "../base/format.js";
import { listen, now, state } from "../base/state.js";
import { t } from "../texts.js";

const RELOAD_MS = 10000;
const REVIEWS = ["unreviewed", "mine_like", "not_mine_like", "unsure"];
const SVG = "http://www.w3.org/2000/svg";
const BAR_WIDTH = 10;
const CHART_HEIGHT = 60;
const KM2 = 1e6;

function svg(tag, attributes, ...children) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, String(value));
  element.append(...children);
  return element;
}

/** Bars of the contacts in each hour; the largest one has the whole height. */
export function histogram(hours) {
  const highest = Math.max(...hours.map((one) => one.contacts));
  const bars = hours.map((one, index) => {
    const height = highest ? (CHART_HEIGHT * one.contacts) / highest : 0;
    const title = svg("title", {});
    title.textContent = t("mission.hour", { time: time(one.start_utc_s).slice(0, 5), count: one.contacts });
    return svg("rect", { x: index * BAR_WIDTH + 1, y: CHART_HEIGHT - height, width: BAR_WIDTH - 2, height }, title);
  });
  const total = hours.reduce((sum, one) => sum + one.contacts, 0);
  return h("figure", { class: "histogram" },
    svg("svg", {
      viewBox: `0 0 ${hours.length * BAR_WIDTH} ${CHART_HEIGHT}`, role: "img", preserveAspectRatio: "none",
      "aria-label": t("mission.histogram", { total, hours: hours.length, highest }),
    }, ...bars),
    h("figcaption", { class: "muted number", text: t("mission.histogram", { total, hours: hours.length, highest }) }));
}

/** A value with its age; "not reported" for null. */
function fact(name, text, utc_s) {
  const value = text === null ? h("span", { class: "muted", text: t("mission.not_reported") }) : text;
  return [h("dt", { text: name }), h("dd", { class: "number" }, value, utc_s ? h("span", { class: "muted age", text: ` ${age(utc_s)}` }) : null)];
}

const squareText = (area_m2) => (area_m2 >= KM2 / 10 ? quantity(area_m2 / KM2, "km²", 2) : quantity(area_m2, "m²", 0));

function areaText(area) {
  return area === null ? null : t("mission.contact_area", { area: squareText(area.area_m2), count: area.contacts });
}

/** Area from the track of a vehicle and the range of its sonar, if the vehicle reports both. */
function coverageFact(coverage) {
  return fact(t("mission.coverage"), coverage === null ? null : t("mission.coverage_value", { area: squareText(coverage.area_m2), count: coverage.legs }), coverage?.time_utc_s);
}

function contactFacts(one) {
  const counts = one.contacts;
  const names = [...REVIEWS, ...Object.keys(counts).filter((name) => !REVIEWS.includes(name))];
  return [
    fact(t("mission.contacts"), String(Object.values(counts).reduce((sum, count) => sum + count, 0)), one.contacts_utc_s),
    names.map((name) => fact(`· ${verdict(name)}`, String(counts[name] ?? 0))),
    fact(t("mission.contacts_lie_in"), areaText(one.area) ?? DASH, one.area?.time_utc_s),
    fact(t("mission.image_bytes"), bytes(one.image_bytes), one.image_bytes_utc_s),
    fact(t("mission.downlink"), t("mission.air_time", { duration: duration(one.downlink.airtime_s), count: one.downlink.transmissions }), one.downlink.time_utc_s),
  ];
}

function uplinkFact(uplink) {
  if (uplink === null) return fact(t("mission.uplink"), t("mission.no_frames"));
  const known = t("mission.air_time", { duration: duration(uplink.airtime_s), count: uplink.packets - uplink.packets_of_unknown_rate });
  const text = uplink.packets_of_unknown_rate ? t("mission.more_packets", { known, count: uplink.packets_of_unknown_rate }) : known;
  return fact(t("mission.uplink"), text, uplink.time_utc_s);
}

function queueFacts(queue) {
  if (queue === null) return fact(t("mission.queue"), null);
  const end = queue.finished_utc_s === null ? t("mission.end_unknown")
    : queue.images_waiting === 0 ? t("mission.queue_empty")
      : t("mission.queue_end", { time: time(queue.finished_utc_s).slice(0, 5), duration: duration(queue.finished_utc_s - now()) });
  return [
    fact(t("mission.queue"), t("mission.images", { count: queue.images_waiting }), queue.time_utc_s),
    fact(t("mission.work_off"), h("span", { class: queue.stale ? "stale" : "", text: end })),
  ];
}

function seabedFact(seabed) {
  if (seabed === null) return fact(t("mission.seabed"), null);
  const text = seabed.warning || t("mission.pd", { pd: percent(100 * seabed.expected_pd) });
  return fact(t("mission.seabed"), h("span", { class: seabed.warning ? "bad" : "", text }), seabed.time_utc_s);
}

function vehicleCard(one) {
  return h("article", { class: "card", "aria-label": one.vehicle_id },
    h("h3", { text: one.vehicle_id }),
    h("dl", { class: "facts" }, contactFacts(one), coverageFact(one.coverage), uplinkFact(one.uplink), queueFacts(one.queue), seabedFact(one.seabed)),
    histogram(one.hours));
}

function operatorRow(one) {
  const verdicts = Object.entries(one.verdicts).map(([name, count]) => `${count} ${verdict(name)}`).join(", ");
  return h("tr", {}, h("td", { text: one.operator }), h("td", { class: "number", text: String(one.decisions) }), h("td", { text: verdicts }),
    h("td", { class: "number", text: one.median_s === null ? DASH : duration(one.median_s) }), h("td", { class: "number", text: age(one.time_utc_s) }));
}

export class MissionView {
  constructor() {
    this.data = null;
    this.body = h("div", { class: "mission-body" });
    this.problem = h("p", { class: "bad hidden", role: "status" });
    this.element = h("section", { class: "mission hidden", "aria-label": t("mission.title"), tabindex: 0 }, this.problem, this.body);
    listen("contact", () => this.#loadLater());
    listen("reload", () => this.#loadLater());
    setInterval(() => this.load(), RELOAD_MS);
    setInterval(() => this.render(), 1000);
    this.timer = 0;
  }

  get visible() { return !this.element.classList.contains("hidden"); }

  #loadLater() {
    this.timer ||= setTimeout(() => { this.timer = 0; this.load(); }, 1000);
  }

  async load() {
    if (!this.visible) return;
    try {
      this.data = await api.mission();
      this.problem.classList.add("hidden");
    } catch (error) {
      this.problem.textContent = t("mission.old", { reason: error.message });
      this.problem.classList.remove("hidden");
    }
    this.render();
  }

  render() {
    if (!this.visible || this.data === null) return;
    const { vehicles, total, operators } = this.data;
    const heads = ["operator", "decisions", "verdicts", "median", "last"].map((name) =>
      h("th", { scope: "col", class: ["operator", "verdicts"].includes(name) ? "" : "number", text: t(`mission.column.${name}`) }));
    const listening = state.fleet?.listening_since_utc_s;
    fill(this.body,
      h("p", { class: "muted", text: listening ? t("mission.basis", { since: since(listening) }) : t("mission.basis_stored") }),
      h("div", { class: "cards" },
        h("article", { class: "card", "aria-label": t("mission.total") }, h("h3", { text: t("mission.total") }),
          h("dl", { class: "facts" }, contactFacts(total)), histogram(total.hours)),
        vehicles.map(vehicleCard)),
      h("h2", { text: t("mission.operators") }),
      operators.length
        ? h("table", {}, h("thead", {}, h("tr", {}, heads)), h("tbody", {}, operators.map(operatorRow)))
        : h("p", { class: "muted", text: t("mission.no_decisions") }));
  }
}
