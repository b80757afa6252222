// The page of the user study. Whether an answer was right is not shown, so that participants do not learn.

import { fill, h, toast } from "/static/js/base/dom.js";
import { duration, percent } from "/static/js/base/format.js";

const main = document.getElementById("panel");
const panel = { id: null, title: "", trial: null, choice: null, sure: null, began_ms: 0 };

async function call(method, path, body) {
  const headers = { "Content-Type": "application/json" };
  if (panel.id) headers["X-Panel"] = panel.id;
  const response = await fetch(path, { method, headers, body: body === undefined ? undefined : JSON.stringify(body), cache: "no-store" });
  const answer = await response.json().catch(() => ({}));
  if (!response.ok) throw new Error(answer.error?.message ?? `The server answered ${response.status}.`);
  return answer;
}

const guarded = (handler) => async (...args) => {
  try { await handler(...args); } catch (error) { toast(error.message, { bad: true }); }
};

function start(info) {
  const name = h("input", { id: "name", required: true, maxlength: 60, autocomplete: "off" });
  const begin = guarded(async () => {
    const { panel: id } = await call("POST", "/api/panel/start", { name: name.value.trim() });
    panel.id = id;
    await next();
  });
  fill(main,
    h("h1", { text: info.title }),
    h("p", { text: `You will see ${info.trials} images that were sent over an acoustic link, one at a time. Select the original of each among ${info.choices}. The page does not show whether you were right. You can stop and continue later with the same name.` }),
    h("form", { on: { submit: (event) => { event.preventDefault(); begin(); } } }, h("label", { for: "name", text: "Your name or number" }), name, h("button", { type: "submit", class: "primary", text: "Start" })),
    h("p", {}, h("button", { type: "button", text: "Results (on this computer only)", on: { click: guarded(results) } })));
  name.focus();
}

async function next() {
  const trial = await call("GET", "/api/panel/next");
  Object.assign(panel, { trial, choice: null, sure: null });
  if (trial.done) {
    fill(main, h("h1", { text: "All images are answered." }), h("p", { text: `${trial.answered} images answered. Thank you.` }), h("button", { type: "button", text: "Results (on this computer only)", on: { click: guarded(results) } }));
    return;
  }
  draw();
  await Promise.all([...main.querySelectorAll("img")].map((image) => image.decode()));
  panel.began_ms = performance.now();
}

function choose(choice) {
  if (!panel.trial || panel.trial.done || choice >= panel.trial.choices.length) return;
  panel.choice = choice;
  for (const button of main.querySelectorAll("[data-choice]")) button.setAttribute("aria-pressed", String(Number(button.dataset.choice) === choice));
  const send = document.getElementById("answer");
  send.disabled = false;
  send.focus();
}

const answer = guarded(async () => {
  if (panel.choice === null) return;
  const seconds = (performance.now() - panel.began_ms) / 1000;
  await call("POST", "/api/panel/answers", { number: panel.trial.number, choice: panel.choice, sure: panel.sure, seconds });
  await next();
});

function draw() {
  const { number, of, shown, choices } = panel.trial;
  const sure = h("input", { type: "range", min: 0, max: 100, step: 10, "aria-label": "How sure" });
  const words = h("output", { text: "not given" });
  sure.addEventListener("input", () => { panel.sure = Number(sure.value) / 100; words.textContent = percent(Number(sure.value)); });
  fill(main,
    h("div", { class: "top" }, h("h1", { text: `Image ${number} of ${of}` }), h("progress", { max: of, value: number - 1, "aria-label": "progress" })),
    h("figure", { class: "shown" }, h("img", { src: shown, alt: "the received image" }), h("figcaption", { text: "as received" })),
    h("p", { text: "Which original is it?" }),
    h("div", { class: "choices" }, choices.map((url, index) => h("button", { type: "button", "aria-pressed": "false", data: { choice: String(index) }, on: { click: () => choose(index) } },
      h("img", { src: url, alt: `original ${index + 1}` }), h("kbd", { text: String(index + 1) })))),
    h("div", { class: "after" },
      h("button", { type: "button", "aria-pressed": "false", data: { choice: "-1" }, on: { click: () => choose(-1) } }, "none of them ", h("kbd", { text: "0" })),
      h("label", {}, "how sure: ", sure, words),
      h("button", { type: "button", class: "primary", id: "answer", disabled: true, on: { click: answer } }, "Answer ", h("kbd", { text: "Enter" }))));
  main.focus();
}

const share = (one) => [
  h("td", { class: "number", text: `${one.right} of ${one.answered}` }), h("td", { class: "number", text: percent(100 * one.share, 1) }),
  h("td", { class: "number", text: `${percent(100 * one.wilson[0], 1)} – ${percent(100 * one.wilson[1], 1)}` }), h("td", { class: "number", text: `${percent(100 * one.exact[0], 1)} – ${percent(100 * one.exact[1], 1)}` }), h("td", { class: "number", text: duration(one.median_s) }),
];

async function results() {
  const { people, pooled, chance, by_group: groups } = await call("GET", "/api/panel/results");
  const row = (name, one) => (one.answered ? h("tr", {}, h("th", { scope: "row", text: name }), share(one)) : h("tr", {}, h("th", { scope: "row", text: name }), h("td", { colspan: 5, text: "nothing answered yet" })));
  fill(main, h("h1", { text: "Results" }), h("p", { text: `By chance alone ${percent(100 * chance, 1)} would be right.` }), h("table", {},
    h("thead", {}, h("tr", {}, ["", "right", "share", "95 % (Wilson)", "95 % (exact)", "time, median"].map((name) => h("th", { scope: "col", class: name ? "number" : "", text: name })))),
    h("tbody", {}, people.map((one) => row(one.name, one)), row("all together", pooled), Object.entries(groups).map(([name, one]) => row(`group ${name}`, one)))),
  h("button", { type: "button", text: "Back", on: { click: () => location.reload() } }));
}

document.addEventListener("keydown", (event) => {
  if (event.target.tagName === "INPUT" && event.target.type !== "range") return;
  if (/^[0-9]$/.test(event.key) && panel.trial && !panel.trial.done) choose(Number(event.key) - 1);
  if (event.key === "Enter" && event.target.tagName !== "BUTTON") answer();
});

const theme = matchMedia("(prefers-color-scheme: dark)").matches ? "night" : "day";
document.documentElement.dataset.theme = theme;
guarded(async () => {
  const info = await call("GET", "/api/panel");
  panel.title = info.title;
  document.title = `${info.title} · user study`;
  start(info);
})();
