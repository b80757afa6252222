// Prints every record of a shore site once, also those missed, for Node 20 and browsers:
// node catch_up.mjs http://127.0.0.1:8000 [CURSOR]
//
// Uses the REST interface of zenohd (zenoh-plugin-rest) and needs `json_mirror = true` in the [c2] table.

const KEY = "contact/*/*";

/** Yield the data of the server-sent events that a GET of `url` returns; call `opened` when the stream is open. */
async function* events(url, opened, signal) {
  const response = await fetch(url, { headers: { accept: "text/event-stream" }, signal });
  if (!response.ok) throw new Error(`${url}: status ${response.status}`);
  opened();
  let text = "";
  const decoder = new TextDecoder();
  for await (const chunk of response.body) {
    text += decoder.decode(chunk, { stream: true });
    const parts = text.split("\n\n");
    text = parts.pop();
    for (const part of parts) {
      const data = part.split("\n").filter((line) => line.startsWith("data:"));
      if (data.length) yield data.map((line) => line.slice(5).trim()).join("\n");
    }
  }
}

/**
 * Call `handle` with every accepted record of a shore site once, as an object.
 *
 * @param {string} server Address of the REST interface.
 * @param {(record: object) => void} handle Called in the order of arrival.
 * @param {{cursor?: string, site?: string, signal?: AbortSignal, refreshMs?: number}} options
 *   `cursor`: where an earlier call ended, empty for all records. `signal` ends the call.
 */
export async function catchUp(server, handle, options = {}) {
  const { site = "shore", refreshMs = 30000 } = options;
  const ended = new AbortController();
  const signal = AbortSignal.any([ended.signal, ...(options.signal ? [options.signal] : [])]);
  let cursor = options.cursor ?? "";
  const ahead = new Set(); // numbers above the cursor that were received as publications
  const buffer = []; // publications during a query
  let querying = true;

  const seqOfCursor = () => Number(cursor.split(".")[1] ?? 0);
  const show = (record) => {
    const { seq } = record.accepted;
    if (seq > seqOfCursor() && !ahead.has(seq)) handle(record);
    return seq;
  };
  const publication = (record) => ahead.add(show(record));

  /** Query the records after the cursor; return whether more remain, null without a complete page. */
  async function nextPage() {
    // `_time` makes the REST interface return all records of a key instead of the last one.
    const parameters = `_time=[..];format=json;pixels=none;after=${cursor}`;
    const response = await fetch(`${server}/sonarpost/v1/${site}/${KEY}?${parameters}`, {
      headers: { accept: "application/json" },
      signal,
    });
    const replies = response.ok ? await response.json() : [];
    const errors = replies.filter((reply) => reply.key === "ERROR" && reply.encoding === "text/plain");
    const refused = errors.find((reply) => !reply.value.includes(": busy: "));
    if (refused) throw new Error(refused.value);
    const values = replies.filter((reply) => reply.key !== "ERROR").map((reply) => reply.value);
    // By number: if several c2 of one archive reply, each sends the same records and a page.
    const found = new Map(values.filter((r) => r.type !== "page").map((r) => [r.accepted.seq, r]));
    const pages = values.filter((r) => r.type === "page").sort((a, b) => b.records - a.records);
    const page = pages[0];
    if (page?.records !== found.size) return null; // c2 is away or busy, or a reply is lost
    [...found.keys()].sort((a, b) => a - b).forEach((seq) => show(found.get(seq)));
    cursor = page.next;
    for (const seq of ahead) if (seq <= seqOfCursor()) ahead.delete(seq);
    return page.more;
  }

  const wait = (ms) =>
    new Promise((resolve, reject) => {
      const timer = setTimeout(resolve, ms);
      signal.addEventListener("abort", () => (clearTimeout(timer), reject(signal.reason)), { once: true });
    });

  async function subscribe(opened) {
    const url = `${server}/sonarpost/v1/${site}/json/${KEY}`;
    for await (const data of events(url, opened, signal)) {
      const record = JSON.parse(data).value;
      if (querying) buffer.push(record);
      else publication(record);
    }
    throw new Error("the event stream has ended");
  }

  async function query() {
    for (;;) {
      querying = true;
      let more = true;
      while (more) more = await nextPage();
      querying = false;
      buffer.splice(0).forEach(publication);
      // Then again what was lost on the way.
      await wait(more === null ? 1000 : refreshMs);
    }
  }

  // Subscribe first: what is published during the queries waits in the buffer.
  let opened;
  const open = new Promise((resolve) => (opened = resolve));
  try {
    await Promise.race([subscribe(opened), open.then(query)]);
  } finally {
    ended.abort();
  }
}

if (globalThis.process?.argv[1]?.endsWith("catch_up.mjs")) {
  const [server, cursor] = process.argv.slice(2);
  const print = (record) =>
    console.log(
      record.accepted.seq,
      record.type,
      record.vehicle_id,
      record.image_id,
      record.version ?? "-",
      record.verdict ?? "-",
    );
  catchUp(server, print, { cursor }).catch((error) => {
    console.error(error.message);
    process.exit(1);
  });
}
