// Link and fleet: present state of vehicles and services, with the age of each value.

import { age, date } from "../base/ages.js";
import { AirTimePanel } from "../requests/airtime_panel.js";
import { fill, h } from "../base/dom.js";
import { DASH, bytes, duration, percent, position, quantity, time } from "../base/format.js";
import { listen, now, state } from "../base/state.js";
import { t } from "../texts.js";

const MAX_FRAMES = 12;
const MAX_QUEUED = 8;

/** A value with its age, marked as stale when it is older than `limit_s`. */
function withAge(text, utc_s, limit_s) {
  if (utc_s === null || utc_s === undefined) return h("span", { class: "stale", text: t("fleet.never") });
  const age_s = now() - utc_s;
  const stale = age_s > limit_s || !state.online;
  return h("span", { class: stale ? "stale number" : "number" }, text ? `${text} ` : "", age(utc_s), stale ? t("fleet.stale_suffix") : "");
}

function fact(name, ...value) {
  return [h("dt", { text: name }), h("dd", { class: "number" }, value)];
}

const until = (utc_s) => (utc_s <= now() ? t("fleet.due") : t("fleet.in", { duration: duration(utc_s - now()) }));

function queueTable(queue) {
  if (!queue) return null;
  const rows = queue.images.slice(0, MAX_QUEUED).map((one) => h("tr", {},
    h("td", {}, h("code", { text: one.image_id })), h("td", { class: "number", text: bytes(one.bytes_left) }),
    h("td", { class: "number", text: one.preview_utc_s === null ? t("fleet.preview_sent") : until(one.preview_utc_s) }),
    h("td", { class: "number", text: until(one.expected_utc_s) })));
  return [
    h("p", {}, t("fleet.waiting", {
      images: t("fleet.images", { count: queue.images_waiting }), messages: t("fleet.messages", { count: queue.messages_waiting }),
      bytes: bytes(queue.message_bytes), interval: duration(queue.packet_interval_s),
    }), " ", withAge(t("fleet.last_report"), queue.time_utc_s, state.info.stale_after_s.vehicle)),
    rows.length ? h("table", {}, h("thead", {}, h("tr", {}, ["image", "left", "preview", "complete"].map((name, i) => h("th", { scope: "col", class: i ? "number" : "", text: t(`fleet.queue.${name}`) })))), h("tbody", {}, rows)) : null,
  ];
}

/** Difficulty of the seabed in the last survey file, as the detector of the vehicle reports it. */
function seabedFacts(seabed) {
  if (!seabed) return [h("p", { class: "muted", text: t("fleet.no_seabed") })];
  const number = (value, decimals) => (value === null ? DASH : value.toFixed(decimals));
  const pd = (value) => (value === null ? DASH : percent(100 * value, 0));
  return [
    seabed.warning ? h("p", { class: "bad", role: "note", text: seabed.warning[0].toUpperCase() + seabed.warning.slice(1) }) : null,
    h("dl", { class: "facts" },
      fact(t("fleet.expected_pd"), h("span", { class: seabed.warning ? "bad" : "", text: pd(seabed.expected_pd) }), " ", withAge("", seabed.time_utc_s, state.info.stale_after_s.service)),
      fact(t("fleet.worst_pd"), pd(seabed.worst_expected_pd)),
      fact(t("fleet.clutter"), t("fleet.clutter_value", { echoes: number(seabed.clutter_per_1000_m2, 0), ripples: number(seabed.ripple_strength, 1) }))),
  ];
}

/** Time of a vehicle's position: that of its status or of its last contact. */
function positionTime(one, limit_s) {
  if (one.lat_deg === null || one.position_utc_s === null) return null;
  if (one.status?.lat_deg != null && one.status.time_utc_s === one.position_utc_s) return withAge("", one.position_utc_s, limit_s);
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
    status.disk_free_bytes === null ? null : t("fleet.disk", { value: bytes(status.disk_free_bytes) }),
    status.images_waiting === null ? null : t("fleet.images", { count: status.images_waiting }),
  ];
  return fact(t("fleet.vehicle_status"), values.filter(Boolean).join(" · "), " ", withAge("", status.received_utc_s, state.info.stale_after_s.vehicle));
}

function vehicleCard(one) {
  const limit_s = state.info.stale_after_s.vehicle;
  const stale = one.last_heard_utc_s === null || now() - one.last_heard_utc_s > limit_s || !state.online;
  const loss = one.loss === null ? DASH : percent(100 * one.loss);
  return h("article", { class: stale ? "card old" : "card", "aria-label": one.vehicle_id },
    h("h3", {}, one.vehicle_id, stale ? h("span", { class: "pill stale", text: t("fleet.stale") }) : h("span", { class: "pill good", text: t("fleet.connected") })),
    h("dl", { class: "facts" },
      fact(t("fleet.last_frames"), withAge("", one.last_heard_utc_s, limit_s)),
      fact(t("fleet.snr"), `${quantity(one.snr_in_db, "dB")} / ${quantity(one.snr_out_db, "dB")}`),
      fact(t("fleet.rate"), one.rate === null ? DASH : t("fleet.rate_value", { rate: one.rate, frames: quantity(one.frames_per_minute, "", 0) })),
      fact(t("fleet.frames"), t("fleet.frames_value", { frames: one.frames, bad: one.bad_frames })),
      fact(t("fleet.loss"), h("span", { class: (one.loss ?? 0) > 0.3 ? "bad" : "", text: loss })),
      fact(t("fleet.range"), quantity(one.range_m, "m", 0), " ", one.range_m === null ? null : withAge("", one.range_utc_s, limit_s)),
      one.measured_range ? fact(t("fleet.measured_range"), quantity(one.measured_range.distance_m, "m", 0), " ", withAge("", one.measured_range.measured_utc_s, limit_s)) : null,
      fact(t("fleet.position"), one.lat_deg === null ? DASH : position(one.lat_deg, one.lon_deg), " ", positionTime(one, limit_s)),
      statusFact(one.status),
      fact(t("fleet.requests"), String(one.open_orders))),
    h("h4", { text: t("fleet.seabed") }), seabedFacts(one.seabed),
    h("h4", { text: t(one.queue ? "fleet.send_queue" : "fleet.no_send_queue", { vehicle: one.vehicle_id }) }), queueTable(one.queue));
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
    this.services = h("tbody", {});
    this.frameList = h("ol", { class: "frames number", "aria-label": t("fleet.received") });
    this.frames = [];
    this.airTime = new AirTimePanel();
    this.element = h("section", { class: "fleet hidden", tabindex: 0, "aria-label": t("fleet.title") },
      h("div", {}, h("h2", { text: t("fleet.vehicles") }), this.vehicles),
      h("div", {}, h("h2", { text: t("fleet.services") }),
        h("table", {}, h("thead", {}, h("tr", {}, ["platform", "service", "state", "last_report", "detail"].map((name) => h("th", { scope: "col", text: t(`fleet.column.${name}`) })))), this.services),
        this.airTime.element, h("h2", { text: t("fleet.received") }), this.frameList));
    listen("fleet", () => this.render());
    listen("frame", (frame) => { this.frames = [frame, ...this.frames].slice(0, MAX_FRAMES); });
    setInterval(() => this.render(), 1000);
  }

  render() {
    if (this.element.classList.contains("hidden") || !state.fleet) return;
    const { vehicles, services } = state.fleet;
    fill(this.vehicles, vehicles.length ? vehicles.map(vehicleCard) : h("p", { class: "muted", text: t("fleet.no_frames") }));
    fill(this.services, services.map(serviceRow));
    fill(this.frameList, this.frames.map((one) => h("li", { text: t("fleet.frame", { time: time(one.utc_s), vehicle: one.vehicle_id ?? "?", bytes: bytes(one.bytes), rate: one.rate ?? DASH, snr: quantity(one.snr_in_db, "dB") }) })));
  }
}
