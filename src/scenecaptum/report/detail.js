// What is said of an object: shortly at the pointer, in full below the picture.

const TIP_ROWS = 5;

function tipOf(result, view, object) {
  const { rows, mapped, magnitude } = result.objects[object];
  const lines = rows.slice(0, TIP_ROWS).map((index) => {
    const row = result.rows[index];
    return make("tr", {}, make("td", {}, ...breakable(row.label), ...markOf(row, result)), make("td", {}, valueOf(row) ?? ""),
      make("td", { class: "number" }, signMark(row, result), withError(row.written)));
  });
  const more = rows.length > TIP_ROWS ? `and ${rows.length - TIP_ROWS} weaker` : null;
  return [
    make("p", { class: "tip-name" }, view.names[object]),
    rows.length ? make("table", {}, make("tbody", {}, ...lines)) : make("p", { class: "muted" }, "none of its parameters was asked about"),
    more ? make("p", { class: "muted" }, more) : null,
    mapped > 1 ? make("p", { class: "muted" }, `all together, root of the sum of squares: ${brief(magnitude)}`) : null,
  ].filter(Boolean);
}

/** Put the tip beside the pointer, inside the window. */
function placeTip(tip, x, y) {
  const { offsetWidth: width, offsetHeight: height } = tip;
  const left = x + 16 + width > window.innerWidth ? x - 16 - width : x + 16;
  const top = y + 20 + height > window.innerHeight ? y - 12 - height : y + 20;
  tip.style.left = `${Math.max(8, Math.min(left, window.innerWidth - width - 8))}px`;
  tip.style.top = `${Math.max(8, top)}px`;
}

function drawDetail(results, current, view, selection) {
  const result = results[current];
  const { rows, objects } = selection;
  const isEmpty = rows.length === 0 && objects.length === 0;
  byId("detail").classList.toggle("chosen", !isEmpty);
  byId("detail").scrollTop = 0;
  if (isEmpty) {
    byId("detail").replaceChildren(...hintOf(result, view.names.length === 0));
    return;
  }
  const clear = make("button", { type: "button", class: "quiet", id: "clear" }, "Clear");
  byId("detail").replaceChildren(
    make("div", { class: "detail-head" }, make("h2", {}, selection.title), clear),
    ...(view.names.length ? [make("p", { class: "muted" }, standingOf(result, view, selection))] : []),
    make("div", { class: "cards" }, ...rows.map((index) => cardOf(results, current, index))));
}

function standingOf(result, view, { kind, objects, rows }) {
  const count = view.width * view.height;
  let covered = 0;
  for (const one of coverage(view, objects)) covered += one;
  const share = (100 * covered) / (255 * count);
  const size = share >= 0.1 ? `${share.toFixed(1)} %` : "less than 0.1 %";
  if (rows.some((row) => result.rows[row].isCamera)) return "It moves the whole picture.";
  if (objects.length === 0) {
    return rows.some((row) => result.rows[row].seenThrough)
      ? "Pixels show it only behind glass or in a mirror."
      : "No pixel shows it directly; it acts by the light that it sends or bounces.";
  }
  if (kind === "object") return `${size} of the picture`;
  const names = objects.map((one) => view.names[one]);
  const listed = names.length > 4 ? `${names.slice(0, 3).join(", ")} and ${names.length - 3} more` : names.join(", ");
  return `Shown by ${listed}: ${size} of the picture`;
}

/** Everything about one parameter: its value, its channels, and where it stands in the other results. */
function cardOf(results, current, index) {
  const result = results[current];
  const row = result.rows[index];
  const names = lettersOf(row) && row.total.length ? lettersOf(row).split(" ") : row.total.map((_, at) => (row.channels === 1 ? "" : String(at + 1)));
  const channels = row.totalWritten.slice(0, 16).map((written, at) => make("span", { class: "channel" },
    names[at] ? make("span", { class: "muted" }, `${names[at]} `) : null, withError(written)));
  const facts = [["value", valueOf(row)], [result.ranked.toLowerCase(), make("span", {}, signMark(row, result), withError(row.written), make("span", { class: "standing" }, `#${index + 1} of ${result.rows.length}`))],
    [result.quantity, channels.length ? make("span", { class: "channels" }, ...channels) : null],
    ...othersOf(results, current, row.name)];
  return make("article", { class: "card" },
    make("h3", {}, ...breakable(row.label), ...markOf(row, result)), make("p", { class: "path" }, row.name),
    make("dl", {}, ...facts.filter(([, value]) => value).flatMap(([name, value]) => [make("dt", {}, ...[name].flat()), make("dd", {}, value)])),
    row.caution === null ? null : make("p", { class: "warning" }, `${cautionMark(row.caution, result)} ${result.cautions[row.caution]}`),
    row.doubt === null ? null : make("p", { class: "warning" }, `${isShared(row.doubt, result) ? "all parameters:" : "?"} ${result.doubts[row.doubt]}`),
    ...row.rangeNotes.map((note) => make("p", { class: "warning" }, `~ ${result.rangeNotes[note]}`)));
}

function othersOf(results, current, name) {
  return results.flatMap((other, index) => {
    const rank = index === current ? -1 : other.rows.findIndex((row) => row.name === name);
    if (rank < 0) return [];
    const row = other.rows[rank];
    return [[breakable(`in ${other.title}`), make("span", {}, signMark(row, other), withError(row.written), make("span", { class: "standing" }, `#${rank + 1} of ${other.rows.length}`))]];
  });
}

/** Before anything is selected: how to read the picture, and what matters out of sight. */
function hintOf(result, isPlan) {
  if (isPlan) return [make("p", { class: "muted hint" }, "Click a row of the table to see all about its parameter.")];
  const hint = `Point at the picture to read an object; click it${hasEffects(result) ? ", or a row of the table," : ""} to keep it lit.`;
  const unseen = result.rows.map((row, index) => ({ row, rank: index + 1 }))
    .filter(({ row, rank }) => row.saliency > 0 && !row.seenThrough && !row.isCamera && objectsOf(result, rank - 1).length === 0);
  const named = unseen.filter(({ rank }) => rank <= 10).slice(0, 3);
  const texts = named.map(({ row, rank }, index) => `${row.label}, #${rank} with ${index ? "" : "an effect of "}${withError(row.written)}`);
  if (unseen.length > named.length) texts.push(`and ${unseen.length - named.length} more`);
  const hidden = named.length === 0 ? null : make("p", { class: "muted" }, `Not in the picture: ${texts.join("; ")}.`);
  return [make("p", { class: "muted hint" }, hint), hidden].filter(Boolean);
}

/** The answer in sentences: a heading for each part, and its lines. */
function drawExplanation(result) {
  const parts = result.explanation.map(([heading, lines]) => make("div", { class: "part" },
    make("h2", {}, heading), make("ul", {}, ...lines.map((line) => make("li", {}, line)))));
  byId("explanation").hidden = parts.length === 0;
  byId("explanation").replaceChildren(...parts);
}

const FACTS = ["scene", "method", "metric", "seed", "spp", "replicates", "resolution", "render_shown", "sensor grid", "sensor", "max_depth", "integrator", "variant", "seconds", "versions"];

function drawFacts(result) {
  // The seed is the one that was given, where it was split for the parts of an explanation.
  const metric = result.metric === result.info.metric ? result.metric : `${result.metric} (${result.info.metric})`;
  const info = { ...result.info, metric, seed: result.info.explanation_seed ?? result.info.seed };
  if (result.isDenoised) info.render_shown = "denoised";
  // Of a sensor grid, the command line says more than the number of rows and columns.
  const isPlan = views[result.view].names.length === 0;
  if (isPlan && info["sensor grid"] !== undefined) delete info.resolution;
  const words = { spp: "samples per pixel", max_depth: "longest path", seconds: "time", ...(isPlan ? { resolution: "sensor grid" } : {}) };
  const text = (key, value) => {
    if (key === "seconds") return value >= 90 ? `${(value / 60).toFixed(1)} min` : `${value.toFixed(1)} s`;
    if (key === "resolution" && Array.isArray(value)) return `${value.join(" × ")}${isPlan ? " sensor points" : ""}`;
    if (value !== null && typeof value === "object") return Object.entries(value).map(([name, one]) => `${name} ${one}`).join(", ");
    return String(value);
  };
  const known = FACTS.filter((key) => info[key] !== undefined && info[key] !== null);
  byId("facts").replaceChildren(...known.map((key) => make("div", { class: key }, make("dt", {}, words[key] ?? key.replaceAll("_", " ")), make("dd", {}, ...breakable(text(key, info[key]))))));
  byId("settings").textContent = JSON.stringify(result.info, null, 2);
}
