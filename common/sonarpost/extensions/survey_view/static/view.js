// The page of `sonarpost survey view`. All addresses are relative: the first part of the path is the token.

const POLL_MS = 1500;
const MARGIN_PX = 5;
const $ = id => document.getElementById(id);
const MAX_ZOOM = 8;

const page = { info: null, contacts: [], picks: [], place: null, cross: null, chosen: -1, zoom: 1, dirty: false, request: 0 };

async function get(path) {
  const response = await fetch(path, { cache: "no-store" });
  const body = await response.json();
  if (!response.ok) throw new Error(body.error?.message ?? body.error ?? `status ${response.status}`);
  return body;
}

function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

function showState(text, isBad = false) {
  $("state").textContent = text;
  $("state").classList.toggle("bad", isBad);
}

// Width of a column and height of a row, in CSS pixels.
const columnPx = () => page.zoom;
const rowPx = () => page.zoom * page.info.stretch;

function layOut() {
  const { rows, columns, tile_rows: tileRows } = page.info;
  $("image").style.width = `${columns * columnPx()}px`;
  $("image").style.height = `${rows * rowPx()}px`;
  for (const tile of $("tiles").children) {
    const first = Number(tile.dataset.number) * tileRows;
    tile.style.top = `${first * rowPx()}px`;
    tile.style.height = `${(Math.min(first + tileRows, rows) - first) * rowPx()}px`;
  }
  drawBoxes();
}

function fittingZoom() {
  return Math.max($("scroll").clientWidth, 100) / page.info.columns;
}

function setZoom(zoom) {
  const scroll = $("scroll");
  const before = page.zoom;
  const middle = [(scroll.scrollLeft + scroll.clientWidth / 2) / before, (scroll.scrollTop + scroll.clientHeight / 2) / before];
  page.zoom = Math.min(Math.max(zoom, fittingZoom() / 2), MAX_ZOOM);
  layOut();
  scroll.scrollTo(middle[0] * page.zoom - scroll.clientWidth / 2, middle[1] * page.zoom - scroll.clientHeight / 2);
}

function box(rows, columns, kind, label, margin) {
  const made = element("button", { type: "button", className: kind, tabIndex: -1 }, element("span", { textContent: label }));
  made.setAttribute("aria-label", label);
  made.style.left = `${columns[0] * columnPx() - margin}px`;
  made.style.top = `${rows[0] * rowPx() - margin}px`;
  made.style.width = `${(columns[1] - columns[0] + 1) * columnPx() + 2 * margin}px`;
  made.style.height = `${Math.max(rows[1] - rows[0], 1) * rowPx() + 2 * margin}px`;
  made.classList.toggle("left", columns[1] > page.info.columns * 0.85);
  return made;
}

const classText = (contact) => contact.class.replace("_", "-");

function drawBoxes() {
  const boxes = page.contacts.map((contact, number) => {
    const label = `${contact.confidence.toFixed(2)} ${classText(contact)}`;
    const made = box(contact.rows, contact.columns, contact.class === "mine_like" ? "mine" : "other", label, MARGIN_PX);
    made.classList.toggle("chosen", number === page.chosen);
    return made;
  });
  const picks = page.picks.map((pick, number) =>
    box([pick.row, pick.row + 1], [pick.column, pick.column], "pick", `pick ${number + 1}`, 2 * MARGIN_PX));
  $("boxes").replaceChildren(...boxes, ...picks);
  $("position").textContent = `${page.chosen < 0 ? "–" : page.chosen + 1} of ${page.contacts.length}`;
  $("previous").disabled = $("next").disabled = page.contacts.length === 0;
  const cross = $("cross");
  cross.hidden = page.cross === null;
  if (page.cross !== null) {
    cross.style.left = `${(page.cross.column + 0.5) * columnPx()}px`;
    cross.style.top = `${(page.cross.row + 0.5) * rowPx()}px`;
  }
}

function scrollTo(row, column) {
  const scroll = $("scroll");
  scroll.scrollTo((column + 0.5) * columnPx() - scroll.clientWidth / 2, (row + 0.5) * rowPx() - scroll.clientHeight / 2);
}

const metres = (value, digits = 1) => (value === null || value === undefined ? "unknown" : `${value.toFixed(digits)} m`);

function positionText(place) {
  if (place.lat_deg === null) return "unknown";
  const lat = `${Math.abs(place.lat_deg).toFixed(6)}° ${place.lat_deg < 0 ? "S" : "N"}`;
  const lon = `${Math.abs(place.lon_deg).toFixed(6)}° ${place.lon_deg < 0 ? "W" : "E"}`;
  return `${lat}, ${lon} ± ${place.position_sigma_m.toFixed(0)} m`;
}

async function showPlace(row, column, contact = null) {
  const request = ++page.request;
  let place;
  // Until the answer is here, there is nothing to pick.
  page.place = null;
  page.cross = { row, column };
  showPickButton();
  drawBoxes();
  try {
    ({ place } = await get(`place?row=${row}&column=${column}`));
  } catch (error) {
    showState(`The place cannot be shown: ${error.message}`, true);
    return;
  }
  if (request !== page.request) return;
  page.place = place === null ? null : { ...place, row, column };
  $("hint").hidden = place !== null;
  $("place").hidden = place === null;
  if (place === null) {
    $("hint").textContent = "Nothing was recorded there.";
  } else {
    $("snippet").src = `snippet.png?row=${row}&column=${column}`;
    const fields = {
      Ping: place.ping_number, Side: place.side, Sample: place.sample,
      "Slant range": metres(place.slant_range_m), "Ground range": metres(place.ground_range_m),
      Position: positionText(place), Time: place.time_utc.replace("T", " "),
    };
    if (contact !== null) {
      fields.Contact = `${classText(contact)}, ${contact.confidence.toFixed(2)} of 2`;
      fields.Length = metres(contact.length_m);
      fields.Height = metres(contact.height_m);
    }
    $("fields").replaceChildren(...Object.entries(fields).flatMap(([name, value]) =>
      [element("dt", { textContent: name }), element("dd", { textContent: String(value) })]));
  }
  showPickButton();
}

function showPickButton() {
  const isPicked = page.place !== null && page.picks.some(pick => pick.pick === page.place.pick);
  $("pick").disabled = page.place === null || isPicked || page.picks.length >= page.info.max_picks;
}

function choose(number) {
  if (page.contacts.length === 0) return;
  page.chosen = (number + page.contacts.length) % page.contacts.length;
  const contact = page.contacts[page.chosen];
  scrollTo(contact.row, contact.column);
  showPlace(contact.row, contact.column, contact);
}

function step(by) {
  if (page.chosen < 0) choose(by > 0 ? 0 : -1);
  else choose(page.chosen + by);
}

function changePicks(picks) {
  page.picks = picks;
  page.dirty = true;
  showPicks();
  $("saved").replaceChildren();
}

function addPick() {
  if (page.place === null || $("pick").disabled) return;
  const { pick, row, column } = page.place;
  changePicks([...page.picks, { pick, row, column }]);
}

function showPicks() {
  $("count").textContent = page.picks.length || "";
  $("picks").replaceChildren(...page.picks.map((pick, number) => {
    const go = element("button", { type: "button", className: "go", textContent: `${number + 1}: ${pick.pick}` });
    go.addEventListener("click", () => { scrollTo(pick.row, pick.column); page.chosen = -1; showPlace(pick.row, pick.column); });
    const remove = element("button", { type: "button", textContent: "✕", title: "Remove this pick" });
    remove.setAttribute("aria-label", `Remove pick ${number + 1}`);
    remove.addEventListener("click", () => changePicks(page.picks.filter(other => other !== pick)));
    return element("li", {}, go, remove);
  }));
  $("save").disabled = !page.dirty;
  showPickButton();
  drawBoxes();
}

async function save() {
  if ($("save").disabled) return;
  const picks = page.picks.map(pick => pick.pick);
  try {
    const response = await fetch("picks", {
      method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ picks }),
    });
    const body = await response.json();
    if (!response.ok) throw new Error(body.error?.message ?? body.error ?? `status ${response.status}`);
    page.dirty = picks.length !== page.picks.length || picks.some((pick, n) => pick !== page.picks[n].pick);
    $("saved").replaceChildren(
      element("p", { textContent: `${body.picks} ${body.picks === 1 ? "pick" : "picks"} in ${body.file}. The contacts, on this host:` }),
      element("code", { textContent: body.command }),
    );
  } catch (error) {
    $("saved").replaceChildren(element("p", { className: "bad", textContent: `Not saved: ${error.message}` }));
  }
  $("save").disabled = !page.dirty;
}

async function pollContacts() {
  try {
    const { state, message, contacts } = await get("contacts");
    if (state === "running") {
      showState("Detecting contacts…");
      setTimeout(pollContacts, POLL_MS);
      return;
    }
    page.contacts = contacts;
    if (state === "failed") showState(`The detection failed: ${message}`, true);
    else showState(`${contacts.length} ${contacts.length === 1 ? "contact" : "contacts"}`);
    drawBoxes();
  } catch (error) {
    showState(`No connection to the command: ${error.message}`, true);
    setTimeout(pollContacts, 2 * POLL_MS);
  }
}

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || page.info === null) return;
  const actions = {
    ArrowLeft: () => step(-1), ArrowUp: () => step(-1), ArrowRight: () => step(1), ArrowDown: () => step(1),
    p: addPick, s: save, "+": () => setZoom(page.zoom * 1.5), "-": () => setZoom(page.zoom / 1.5), 0: () => setZoom(fittingZoom()),
  };
  const action = actions[event.key] ?? actions[event.key.toLowerCase()];
  if (action === undefined) return;
  event.preventDefault();
  action();
}

function onClick(event) {
  const frame = $("image").getBoundingClientRect();
  const column = Math.floor((event.clientX - frame.left) / columnPx());
  const row = Math.floor((event.clientY - frame.top) / rowPx());
  if (row < 0 || column < 0 || row >= page.info.rows || column >= page.info.columns) return;
  const shown = [...$("boxes").children].indexOf(event.target.closest("#boxes button"));
  page.chosen = shown;
  showPlace(row, column, shown < 0 ? null : page.contacts[shown]);
}

async function start() {
  try {
    page.info = await get("info");
  } catch (error) {
    showState(`The recording cannot be shown: ${error.message}`, true);
    return;
  }
  const { file, pings, tiles, picks, warnings } = page.info;
  document.title = `${file} – sonarpost survey`;
  $("title").textContent = `${file}, ${pings} pings`;
  $("tiles").replaceChildren(...Array.from({ length: tiles }, (_, number) => {
    const tile = element("img", { loading: "lazy", alt: "", draggable: false });
    tile.dataset.number = number;
    tile.src = `tile/${number}.png`;
    return tile;
  }));
  $("notes").hidden = warnings.length === 0;
  $("notes").querySelector("ul").replaceChildren(...warnings.map(text => element("li", { textContent: text })));
  page.picks = picks;
  page.zoom = fittingZoom();
  layOut();
  showPicks();
  $("image").addEventListener("click", onClick);
  $("pick").addEventListener("click", addPick);
  $("save").addEventListener("click", save);
  $("previous").addEventListener("click", () => step(-1));
  $("next").addEventListener("click", () => step(1));
  $("zoom-in").addEventListener("click", () => setZoom(page.zoom * 1.5));
  $("zoom-out").addEventListener("click", () => setZoom(page.zoom / 1.5));
  $("fit").addEventListener("click", () => setZoom(fittingZoom()));
  document.addEventListener("keydown", onKey);
  window.addEventListener("beforeunload", event => { if (page.dirty) event.preventDefault(); });
  pollContacts();
}

start();
