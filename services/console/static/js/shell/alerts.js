// Alerts for contacts that arrive with a detector confidence above a threshold of the user: tone, notification of the
// browser, count in the page's title, stripe of the row.

import { h, labelled, showDialog } from "../base/dom.js";
import { emit, listen, setting, state } from "../base/state.js";
import { number, t } from "../texts.js";

const DEFAULT_THRESHOLD = "1.5";
const THRESHOLDS = ["0", "1", "1.5", "1.8"]; // of 2
const TONE_HZ = 880;
const TONE_S = 0.18;
const TONES = 3;
const MAX_KNOWN = 10000;

const unseen = new Set(); // contacts with an alert that have not been opened
const known = new Set(); // contacts that have been judged, so that a repeated event alerts once
const undecided = new Set(); // new contacts whose confidence has not arrived

export const hasAlert = (id) => unseen.has(id);
export const alertCount = () => unseen.size;

const isOn = () => setting("alerts.on") === "true";
/** The threshold in use: that of the list which is not above the stored one. */
const threshold = () => THRESHOLDS.findLast((one) => Number(one) <= Number(setting("alerts.threshold") ?? DEFAULT_THRESHOLD)) ?? "0";
const thresholdText = (one) => (one === "0" ? t("alerts.every") : number(Number(one), 1));
const isChosen = (name) => setting(`alerts.${name}`) !== "false";

let audio = null;

/** The audio output; browsers start it only after a key or click on the page. */
function audioOutput() {
  audio ??= new AudioContext();
  if (audio.state === "suspended") audio.resume();
  return audio;
}

function playTone() {
  const output = audioOutput();
  const gain = output.createGain();
  gain.connect(output.destination);
  const oscillator = output.createOscillator();
  oscillator.frequency.value = TONE_HZ;
  oscillator.connect(gain);
  const start_s = output.currentTime;
  gain.gain.setValueAtTime(0, start_s);
  for (let number = 0; number < TONES; number += 1) {
    gain.gain.setValueAtTime(0.3, start_s + 2 * number * TONE_S);
    gain.gain.setValueAtTime(0, start_s + (2 * number + 1) * TONE_S);
  }
  oscillator.start(start_s);
  oscillator.stop(start_s + 2 * TONES * TONE_S);
}

const mayNotify = () => "Notification" in window && Notification.permission === "granted";

function notify(row) {
  const note = new Notification(t("alerts.notification", { name: row.name }), {
    body: t("alerts.confidence", { confidence: number(row.atd_confidence, 2) }), tag: row.id,
  });
  note.onclick = () => { window.focus(); emit("view", { name: "review" }); emit("select", { id: row.id }); note.close(); };
}

function alert(row) {
  unseen.add(row.id);
  if (isChosen("sound")) playTone();
  if (isChosen("notify") && mayNotify()) notify(row);
  emit("alerts");
}

function judge(row, isNew) {
  if (known.has(row.id) || !(isNew || undecided.has(row.id))) return;
  undecided.delete(row.id);
  if (row.atd_confidence === null) {
    undecided.add(row.id);
    return;
  }
  known.add(row.id);
  if (known.size > MAX_KNOWN) known.delete(known.values().next().value);
  if (isOn() && row.atd_confidence >= Number(threshold()) && row.id !== state.selected) alert(row);
}

function opened(id) {
  if (unseen.delete(id)) emit("alerts");
}

function checkbox(name, checked) {
  return h("input", { type: "checkbox", id: `alerts-${name}`, checked });
}

async function showSettings(draw) {
  const on = checkbox("on", isOn());
  const sound = checkbox("sound", isChosen("sound"));
  const notification = checkbox("notify", isChosen("notify"));
  const level = h("select", { id: "alerts-threshold" }, THRESHOLDS.map((value) => h("option", { value, text: thresholdText(value) })));
  level.value = threshold();
  const test = h("button", { type: "button", text: t("alerts.test"), on: { click: playTone } });
  const body = h("div", { class: "alert-settings" },
    labelled(t("alerts.on"), on), labelled(t("alerts.threshold"), level), labelled(t("alerts.sound"), sound), test,
    labelled(t("alerts.notify"), notification), h("p", { class: "muted", text: t("alerts.note") }));
  const chosen = await showDialog(t("alerts.title"), body, [
    { label: t("alerts.save"), value: "save", primary: true }, { label: t("dialog.cancel"), value: null },
  ]);
  if (chosen !== "save") return;
  setting("alerts.threshold", level.value);
  setting("alerts.on", on.checked);
  setting("alerts.sound", sound.checked);
  setting("alerts.notify", notification.checked);
  if (on.checked && sound.checked) audioOutput();
  draw();
  // The browser asks the user for the permission.
  if (on.checked && notification.checked && "Notification" in window) await Notification.requestPermission();
}

/** Start to judge the contacts that arrive; returns the button for the header. */
export function alertButton() {
  const count = h("span", { class: "alert-count number" });
  const bell = h("span", { class: "bell", "aria-hidden": "true" });
  const button = h("button", { type: "button", id: "alerts", on: { click: () => showSettings(draw) } }, bell, count);
  const draw = () => {
    const label = isOn() ? t("alerts.button", { confidence: thresholdText(threshold()), count: unseen.size }) : t("alerts.button_off");
    bell.classList.toggle("off", !isOn());
    button.title = label;
    button.setAttribute("aria-label", label);
    count.textContent = unseen.size ? number(unseen.size) : "";
  };
  listen("contact", ({ contact, new: isNew }) => judge(contact, isNew));
  listen("select", ({ id }) => opened(id));
  listen("alerts", draw);
  // A browser starts the audio output of a loaded page at the first key or click.
  const start = () => { if (isOn() && isChosen("sound")) audioOutput(); };
  for (const name of ["keydown", "pointerdown"]) addEventListener(name, start, { once: true });
  draw();
  return button;
}
