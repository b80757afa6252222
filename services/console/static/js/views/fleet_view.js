// Link and fleet: present state of vehicles and services, with the age of each value.

import { age, date, isStale } from "../base/ages.js";
import { fill, h } from "../base/dom.js";
import { DASH, bytes, duration, number, percent, position, quantity } from "../base/format.js";
import { listen, now, state } from "../base/state.js";
import { t } from "../texts.js";


/** A value with its age, marked as stale when it is older than `limit_s`. */
function withAge(text, utc_s, limit_s) {
  if (utc_s === null || utc_s === undefined) return h("span", { class: "stale", text: t("fleet.never") });
  const stale = isStale(utc_s, limit_s);
  return h("span", { class: stale ? "stale number" : "number" }, text ? `${text} ` : "", age(utc_s), stale ? t("fleet.stale_suffix") : "");
}

function fact(name, ...value) {
  return [h("dt", { text: name }), h("dd", { class: "number" }, value)];
}

/** What waits in the transmit queue of a vehicle. */
const queueText = (queue) => t("fleet.waiting", {
  images: t("fleet.images", { count: queue.images_waiting }), messages: t("fleet.messages", { count: queue.messages_waiting }),
  bytes: bytes(queue.message_bytes), interval: duration(queue.packet_interval_s),
});

/** Difficulty of the seabed in the last survey file, as the detector of the vehicle reports it. */
function seabedFacts(seabed) {
  if (!seabed) return h("p", { class: "muted", text: t("fleet.no_seabed") });
  const pd = (value) => (value === null ? DASH : percent(100 * value, 0));
  return h("dl", { class: "facts" },
    fact(t("fleet.expected_pd"), pd(seabed.expected_pd), " ", withAge("", seabed.time_utc_s, state.info.stale_after_s.service)),
    fact(t("fleet.worst_pd"), pd(seabed.worst_expected_pd)),
    fact(t("fleet.clutter"), t("fleet.clutter_value", { echoes: quantity(seabed.clutter_per_1000_m2, "", 0), ripples: quantity(seabed.ripple_strength) })));
}

/** Time of a vehicle's position: that of its status or of its last contact. */
function positionTime(one, limit_s) {
  if (one.lat_deg === null || one.position_utc_s === null) return null;
  if (Number.isFinite(one.status?.lat_deg) && one.status.time_utc_s === one.position_utc_s) return withAge("", one.position_utc_s, limit_s);
  const is_old = now() - one.position_utc_s > 86400;
  return is_old ? h("span", { class: "stale", text: t("fleet.seen_on", { date: date(one.position_utc_s) }) }) : withAge(t("fleet.seen"), one.position_utc_s, limit_s);
}

/** What the vehicle reports of itself over the acoustic link. */
function statusFact(status) {
  if (!status) return null;
  const values = [
    status.heading_deg === null ? null : t("fleet.heading", { value: quantity(status.heading_deg, "°", 0) }),
    status.speed_mps === null ? null : t("fleet.speed", { value: quantity(status.speed_mps, "m/s") }),
    status.depth_m === null ? null : t("fleet.depth", { value: quantity(status.depth_m, "m") }),
    status.altitude_m === null ? null : t("fleet.altitude", { value: quantity(status.altitude_m, "m") }),
    status.battery === null ? null : t("fleet.battery", { value: percent(100 * status.battery) }),
    status.disk_free_bytes === null ? null : t("fleet.disk", { value: quantity(status.disk_free_bytes / 1e9, "GB") }),
  ];
  return fact(t("fleet.vehicle_status"), values.filter(Boolean).join(" · "), " ", withAge("", status.received_utc_s, state.info.stale_after_s.vehicle));
}

/**
 * What a vehicle still has to send, and when it is done at the present rate.
 * @param {any} one vehicle of the fleet
 */
function toSend({ queue, status }) {
  const waiting = queue ? queue.images_waiting : status?.images_waiting ?? null;
  if (waiting === null) return t("fleet.no_send_queue");
  if (waiting === 0) return t("fleet.nothing_to_send");
  const images = t("fleet.to_send", { count: waiting });
  // The list may be shorter than the queue: then its end is not known.
  if (queue?.images.length !== waiting) return images;
  const end_utc_s = Math.max(...queue.images.map((image) => image.expected_utc_s));
  return end_utc_s <= now() ? `${images}, ${t("fleet.due")}` : t("fleet.done", { images, duration: duration(end_utc_s - now()) });
}

/** A vehicle: one line that states whether it is alive and when it is done, and its numbers on request. */
class VehicleCard {
  /** @param {string} name of the vehicle */
  constructor(name) {
    this.pill = h("span", { class: "pill" });
    this.line = h("p", {});
    this.facts = h("div", {});
    this.element = h("article", { class: "card", "aria-label": name }, h("h3", {}, name, this.pill), this.line,
      h("details", {}, h("summary", { text: t("fleet.details") }), this.facts));
  }

  /** @param {any} one vehicle of the fleet */
  show(one) {
    const limit_s = state.info.stale_after_s.vehicle;
    const stale = one.last_heard_utc_s === null || isStale(one.last_heard_utc_s, limit_s);
    this.element.classList.toggle("old", stale);
    this.pill.className = stale ? "pill stale" : "pill good";
    this.pill.textContent = t(stale ? "fleet.stale" : "fleet.connected");
    const reported_utc_s = one.queue ? one.queue.time_utc_s : Number.isFinite(one.status?.images_waiting) ? one.status.received_utc_s : null;
    fill(this.line, `${t("fleet.last_frames")} `, withAge("", one.last_heard_utc_s, limit_s), ` · ${toSend(one)}`,
      reported_utc_s !== null && isStale(reported_utc_s, limit_s) ? [" · ", withAge(t("fleet.column.last_report"), reported_utc_s, limit_s)] : null,
      one.seabed?.warning ? h("span", { class: "bad seabed", role: "note", text: t("fleet.seabed_warning", { pd: percent(100 * one.seabed.expected_pd) }) }) : null);
    fill(this.facts,
      h("dl", { class: "facts" },
        fact(t("fleet.snr"), `${quantity(one.snr_in_db, "dB")} / ${quantity(one.snr_out_db, "dB")}`),
        fact(t("fleet.rate"), one.rate === null ? DASH : t("fleet.rate_value", { rate: one.rate, frames: quantity(one.frames_per_minute, "", 0) })),
        fact(t("fleet.frames"), t("fleet.frames_value", { frames: one.frames, bad: one.bad_frames })),
        fact(t("fleet.loss"), h("span", { class: (one.loss ?? 0) > 0.3 ? "bad" : "", text: one.loss === null ? DASH : percent(100 * one.loss) })),
        fact(t("fleet.range"), quantity(one.range_m, "m", 0)),
        one.measured_range ? fact(t("fleet.measured_range"), quantity(one.measured_range.distance_m, "m", 0), " ", withAge("", one.measured_range.measured_utc_s, limit_s)) : null,
        fact(t("fleet.position"), one.lat_deg === null ? DASH : position(one.lat_deg, one.lon_deg), " ", positionTime(one, limit_s)),
        statusFact(one.status),
        one.queue ? fact(t("fleet.send_queue"), queueText(one.queue), " ", withAge("", one.queue.time_utc_s, limit_s)) : null,
        fact(t("fleet.requests"), number(one.open_requests))),
      h("h4", { text: t("fleet.seabed") }), seabedFacts(one.seabed));
  }
}

function serviceRow(one) {
  const stale = one.stale || !state.online;
  const tone = stale || one.state === "silent" ? "stale" : one.state === "ok" ? "good" : one.state === "degraded" ? "bad" : "";
  return h("tr", {}, h("td", { text: one.platform_id }), h("td", { text: one.service }),
    h("td", {}, h("span", { class: tone, text: stale && one.state !== "silent" ? t("fleet.was", { state: t(`fleet.state.${one.state}`) }) : t(`fleet.state.${one.state}`) })),
    h("td", {}, withAge("", one.time_utc_s, state.info.stale_after_s.service)), h("td", { class: "detail", text: one.detail }));
}

export class FleetView {
  constructor() {
    this.vehicles = h("div", { class: "cards" });
    this.cards = new Map(); // name of a vehicle → its card
    this.noFrames = h("p", { class: "muted", text: t("fleet.no_frames") });
    this.services = h("tbody", {});
    this.element = h("section", { class: "fleet hidden", tabindex: 0, "aria-label": t("fleet.title") },
      h("div", {}, h("h2", { text: t("fleet.vehicles") }), this.vehicles),
      h("div", {}, h("h2", { text: t("fleet.services") }),
        h("table", {}, h("thead", {}, h("tr", {}, ["platform", "service", "state", "last_report", "detail"].map((name) => h("th", { scope: "col", text: t(`fleet.column.${name}`) })))), this.services)));
    listen("fleet", () => this.render());
    setInterval(() => this.render(), 1000);
  }

  render() {
    if (this.element.classList.contains("hidden") || !state.fleet) return;
    const { vehicles, services } = state.fleet;
    for (const { vehicle_id: name } of vehicles) if (!this.cards.has(name)) this.cards.set(name, new VehicleCard(name));
    const cards = vehicles.map((one) => { const card = this.cards.get(one.vehicle_id); card.show(one); return card.element; });
    const wanted = cards.length ? cards : [this.noFrames];
    const shown = [...this.vehicles.children];
    // A card stays where it is: moving it would take the focus from it.
    if (wanted.length !== shown.length || wanted.some((card, index) => card !== shown[index])) fill(this.vehicles, wanted);
    fill(this.services, services.map(serviceRow));
  }
}
