// Link and fleet: present state of vehicles and services, with the age of each value.

import { fill, h } from "./dom.js";
import { DASH, bytes, duration, percent, position, quantity, time } from "./format.js";
import { listen, now, state } from "./state.js";

const MAX_FRAMES = 12;
const MAX_QUEUED = 8;

/** A value with its age, marked as stale when it is older than `limit_s`. */
function withAge(text, utc_s, limit_s) {
  if (utc_s === null || utc_s === undefined) return h("span", { class: "stale", text: "never" });
  const age_s = now() - utc_s;
  const stale = age_s > limit_s || !state.online;
  return h("span", { class: stale ? "stale number" : "number" }, text ? `${text} ` : "", `${duration(age_s)} ago${stale ? " — stale" : ""}`);
}

function fact(name, ...value) {
  return [h("dt", { text: name }), h("dd", { class: "number" }, value)];
}

const plural = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;
const until = (utc_s) => (utc_s <= now() ? "due" : `in ${duration(utc_s - now())}`);

function queueTable(queue) {
  if (!queue) return h("p", { class: "muted", text: "The queue of the vehicle is not visible here." });
  const rows = queue.images.slice(0, MAX_QUEUED).map((one) => h("tr", {},
    h("td", {}, h("code", { text: one.image_id })), h("td", { class: "number", text: bytes(one.bytes_left) }),
    h("td", { class: "number", text: one.preview_utc_s === null ? "sent" : until(one.preview_utc_s) }),
    h("td", { class: "number", text: until(one.expected_utc_s) })));
  return [
    h("p", {}, `${plural(queue.images_waiting, "image")} and ${plural(queue.messages_waiting, "message")} (${bytes(queue.message_bytes)}) waiting; one packet every ${duration(queue.packet_interval_s)}. `, withAge("", queue.time_utc_s, state.info.stale_after_s.vehicle)),
    rows.length ? h("table", {}, h("thead", {}, h("tr", {}, ["image", "left", "preview", "complete"].map((name, i) => h("th", { scope: "col", class: i ? "number" : "", text: name })))), h("tbody", {}, rows)) : null,
  ];
}

/** Difficulty of the seabed in the last survey file, as the detector of the vehicle reports it. */
function seabedFacts(seabed) {
  if (!seabed) return [h("p", { class: "muted", text: "The seabed of the vehicle is not known here." })];
  const number = (value, decimals) => (value === null ? DASH : value.toFixed(decimals));
  const pd = (value) => (value === null ? DASH : percent(100 * value, 0));
  return [
    seabed.warning ? h("p", { class: "bad", role: "note", text: seabed.warning[0].toUpperCase() + seabed.warning.slice(1) }) : null,
    h("dl", { class: "facts" },
      fact("expected Pd, last file", h("span", { class: seabed.warning ? "bad" : "", text: pd(seabed.expected_pd) }), " ", withAge("", seabed.time_utc_s, state.info.stale_after_s.service)),
      fact("worst of the last hour", pd(seabed.worst_expected_pd)),
      fact("clutter, ripples", `${number(seabed.clutter_per_1000_m2, 0)} echoes per 1000 m², ${number(seabed.ripple_strength, 1)}`)),
  ];
}

function vehicleCard(one) {
  const limit_s = state.info.stale_after_s.vehicle;
  const stale = one.last_heard_utc_s === null || now() - one.last_heard_utc_s > limit_s || !state.online;
  const loss = one.loss === null ? DASH : percent(100 * one.loss);
  return h("article", { class: stale ? "card old" : "card", "aria-label": one.vehicle_id },
    h("h3", {}, one.vehicle_id, stale ? h("span", { class: "pill stale", text: "stale" }) : h("span", { class: "pill good", text: "connected" })),
    h("dl", { class: "facts" },
      fact("last frame", withAge("", one.last_heard_utc_s, limit_s)),
      fact("SNR in / out", `${quantity(one.snr_in_db, "dB")} / ${quantity(one.snr_out_db, "dB")}`),
      fact("rate", one.rate === null ? DASH : `${one.rate}, ${quantity(one.frames_per_minute, "frames a minute")}`),
      fact("frames", `${one.frames}, ${one.bad_frames} bad`),
      fact("loss, last 20 packets", h("span", { class: (one.loss ?? 0) > 0.3 ? "bad" : "", text: loss })),
      fact("range", quantity(one.range_m, "m", 0), " ", one.range_m === null ? null : withAge("", one.range_utc_s, limit_s)),
      fact("position", one.lat_deg === null ? DASH : position(one.lat_deg, one.lon_deg), " ", one.lat_deg === null ? null : withAge("at its last contact,", one.position_utc_s, limit_s)),
      fact("open requests", String(one.open_orders))),
    h("h4", { text: "Seabed" }), seabedFacts(one.seabed),
    h("h4", { text: "Transmit queue" }), queueTable(one.queue));
}

function serviceRow(one) {
  const stale = one.stale || !state.online;
  const tone = stale || one.state === "silent" ? "stale" : one.state === "ok" ? "good" : one.state === "degraded" ? "bad" : "";
  return h("tr", {}, h("td", { text: one.platform_id }), h("td", { text: one.service }),
    h("td", {}, h("span", { class: tone, text: stale && one.state !== "silent" ? `was ${one.state}` : one.state })),
    h("td", {}, withAge("", one.time_utc_s, state.info.stale_after_s.service)), h("td", { class: "detail", text: one.detail }));
}

export class FleetView {
  constructor() {
    this.vehicles = h("div", { class: "cards" });
    this.services = h("tbody", {});
    this.frameList = h("ol", { class: "frames number", "aria-label": "Received frames" });
    this.frames = [];
    this.element = h("section", { class: "fleet hidden", tabindex: 0, "aria-label": "Link and fleet" },
      h("div", {}, h("h2", { text: "Vehicles" }), this.vehicles),
      h("div", {}, h("h2", { text: "Services" }),
        h("table", {}, h("thead", {}, h("tr", {}, ["platform", "service", "state", "last health", "detail"].map((name) => h("th", { scope: "col", text: name })))), this.services),
        h("h2", { text: "Received frames" }), this.frameList));
    listen("fleet", () => this.render());
    listen("frame", (frame) => { this.frames = [frame, ...this.frames].slice(0, MAX_FRAMES); });
    setInterval(() => this.render(), 1000);
  }

  render() {
    if (this.element.classList.contains("hidden") || !state.fleet) return;
    const { vehicles, services } = state.fleet;
    fill(this.vehicles, vehicles.length ? vehicles.map(vehicleCard) : h("p", { class: "muted", text: "No frame of a vehicle has been received." }));
    fill(this.services, services.map(serviceRow));
    fill(this.frameList, this.frames.map((one) => h("li", { text: `${time(one.utc_s)}  ${one.vehicle_id ?? "?"}  ${bytes(one.bytes)}  rate ${one.rate ?? DASH}  ${quantity(one.snr_in_db, "dB")}` })));
  }
}
