// The page: what is chosen, and what follows from it.

const state = {
  current: 0,
  sort: { by: "rank", reversed: false },
  filter: "",
  all: false, // the whole table, not only its first rows
  selection: { kind: null, name: null, title: "", rows: [], objects: [] },
  hovered: [],
  pointer: null,
};
const results = data.results;
let views = [];
let texels = [];

const result = () => results[state.current];
const view = () => views[result().view];
const texelsOf = (one) => texels[results.indexOf(one)];
const chosen = (name) => document.querySelector(`[name="${name}"]:checked`).value;
const isAlike = (one) => one.metric === result().metric && one.quantity === result().quantity;

/** The scale of this picture, or of all whose metric is the same. */
function scaleNow() {
  const scale = {
    signed: chosen("quantity") === "signed" && Boolean(result().signs), kind: chosen("scale"), texels: byId("texels").checked,
  };
  const alike = byId("shared").checked ? results.filter(isAlike) : [result()];
  const largest = Math.max(...alike.map((one) => ((scale.texels && texelsOf(one)) || one).largest ?? 0));
  return { ...scale, largest };
}

// ------------------------------------------------------------------------------------------------- drawing

function drawOverlay() {
  const scale = scaleNow();
  paintOverlay(byId("overlay"), view(), result(), scale);
  const other = otherResult();
  if (other) paintOverlay(byId("other-overlay"), views[other.view], other, scale);
  drawScale(result(), scale);
}

function drawOpacity() {
  const opacity = hasEffects(result()) ? byId("opacity").value / 100 : 0;
  for (const map of ["overlay", "other-overlay"]) byId(map).style.opacity = opacity;
  // Below a map in colour, colours of the render would be read as part of it.
  for (const picture of ["render", "other"]) byId(picture).style.filter = `grayscale(${opacity})`;
  byId("opacity-value").textContent = opacity ? `${byId("opacity").value} %` : "off";
  byId("below").classList.toggle("off", opacity === 0);
}

/** The result to compare the picture with: the next one of the same metric and camera, with another picture.
 *  The camera may be what a comparison is about. */
function otherResult() {
  const ahead = results.map((_, step) => results[(state.current + 1 + step) % results.length]);
  const hasItsCamera = (one) => Boolean(data.comparison) || one.info.sensor === result().info.sensor;
  return ahead.find((one) => isAlike(one) && one.picture !== result().picture && hasItsCamera(one)
    && views[one.view].width === view().width && views[one.view].height === view().height);
}

/** Show the other picture, with the map of its result, beside the split: the earlier result is on the left. */
function drawSplit() {
  const other = otherResult();
  const share = Number(byId("split").value);
  const isAfter = results.indexOf(other) > state.current;
  const [left, right] = [`inset(0 ${100 - share}% 0 0)`, `inset(0 0 0 ${share}%)`];
  byId("split-choice").hidden = !other;
  byId("below").classList.toggle("compared", Boolean(other));
  if (other) byId("other").src = data.pictures[other.picture];
  for (const part of ["other", "other-overlay"]) {
    byId(part).hidden = !other || share === (isAfter ? 100 : 0);
    byId(part).style.clipPath = isAfter ? right : left;
  }
  const own = !other ? "none" : isAfter ? left : right;
  byId("overlay").style.clipPath = own;
  // Where the other picture shows the objects at other places, marks are of one half only.
  for (const marks of ["shade", "lines"]) byId(marks).style.clipPath = other?.view === result().view ? "none" : own;
  byId("picture").classList.toggle("split", Boolean(other) && share > 0 && share < 100);
  byId("picture").style.setProperty("--split", `${share}%`);
  const [before, after] = isAfter ? [result(), other] : [other, result()];
  byId("split-before").textContent = other && share > 0 ? before.title : "";
  byId("split-after").textContent = other && share < 100 ? after.title : "";
}

function drawMarks() {
  paintShade(byId("shade"), view(), state.selection.objects);
  drawOutlines();
}

function drawOutlines() {
  drawLines(byId("lines"), view(), state.hovered, state.selection.objects);
  drawArrows(byId("lines"), view(), result().arrows);
}

function drawTable() {
  drawColumns(result(), state.sort, sortBy);
  const arranged = arrangedRows(result(), view(), state.sort, state.filter);
  const shown = state.all || state.filter ? arranged : firstRows(arranged, state.selection.rows);
  drawRows(result(), shown, { select: selectRow, preview: previewRow });
  markSelected(state.selection.rows);
  byId("more").hidden = shown.length === arranged.length || !hasEffects(result());
  byId("more").textContent = `Show all ${arranged.length}`;
}

const PLAN_SCALE = 2; // pixels of a plan for each one of the page

/** A plan in place of a picture shows no objects, so there is nothing to paint on it and to point at. */
function drawPlan() {
  const isPlan = view().names.length === 0;
  byId("main").classList.toggle("plan", isPlan);
  byId("picture").hidden = isPlan;
  byId("plan").hidden = !isPlan;
  const isOneOf = isPlan && results.length > 1;
  byId("plan-of").hidden = !isOneOf;
  if (isOneOf) {
    byId("plan-of").replaceChildren(make("span", { class: "result-title" }, result().title),
      make("span", { class: "muted hint" }, "Click another card above to see its plan."));
  }
  if (!isPlan) return;
  byId("plan").src = data.pictures[result().picture];
  byId("plan").style.maxWidth = `min(100%, ${view().width / PLAN_SCALE}px)`;
}

function drawResult() {
  byId("render").src = data.pictures[result().picture];
  byId("picture").style.aspectRatio = `${view().width} / ${view().height}`;
  byId("main").style.setProperty("--ratio", view().width / view().height);
  byId("texels-choice").hidden = !texelsOf(result());
  byId("shared-choice").hidden = results.filter(isAlike).length < 2;
  document.querySelector('[value="signed"]').disabled = !result().signs;
  byId("main").classList.toggle("effectless", !hasEffects(result()));
  drawPlan();
  drawExplanation(result());
  drawOpacity();
  drawSplit();
  drawOverlay();
  drawTable();
  drawNotes(result());
  drawFacts(result());
  select(found(state.selection));
}

// ------------------------------------------------------------------------------------------------- on paper

/** Draw each of several results in full, for paper; of one, the page itself is printed. */
function drawPrinted() {
  if (results.length < 2) return;
  const { current, selection } = state;
  const copies = results.map((_, index) => {
    Object.assign(state, { current: index, selection });
    drawResult();
    return printedCopy();
  });
  Object.assign(state, { current, selection });
  drawResult();
  byId("printed").classList.toggle("pair", Boolean(otherResult()));
  byId("printed").replaceChildren(...copies);
}

/** The value of a result's metric with its error, called relaxed where that by the definition may differ. */
function headline({ written, unit, isRelaxed }) {
  return [withError(written), unit].filter(Boolean).join(" ") + (isRelaxed ? ", relaxed" : "");
}

const HALVES = ["other", "other-overlay", "split-before", "split-after"]; // of a picture with a divider

/** Copy what is shown of the result: its picture or plan as a whole, its sentences, and its table. */
function printedCopy() {
  const head = make("h2", {}, `${result().title}: ${headline(result())}`);
  const hasMap = view().names.length > 0 && hasEffects(result()) && byId("opacity").value > 0;
  const shown = [byId("explanation"), document.querySelector(".frame"), ...(hasMap ? [document.querySelector(".legend")] : []), document.querySelector(".list")];
  const copies = shown.filter((one) => !one.hidden).map(copyOf);
  for (const copy of copies) {
    for (const half of HALVES) copy.querySelector(`#${half}`)?.remove();
    for (const one of ["overlay", "shade", "lines"]) copy.querySelector(`#${one}`)?.style.removeProperty("clip-path");
    copy.querySelector("#picture")?.classList.remove("split");
  }
  return make("div", {}, head, ...copies);
}

/** Copy an element with what is painted on its canvases. */
function copyOf(element) {
  const copy = element.cloneNode(true);
  const painted = element.querySelectorAll("canvas");
  copy.querySelectorAll("canvas").forEach((canvas, index) => {
    if (painted[index].width && painted[index].height) canvas.getContext("2d").drawImage(painted[index], 0, 0);
  });
  return copy;
}

// ----------------------------------------------------------------------------------------------- selecting

const nothing = () => ({ kind: null, name: null, title: "", rows: [], objects: [] });

function ofRow(index) {
  const row = result().rows[index];
  return { kind: "row", name: row.name, title: row.label, rows: [index], objects: objectsOf(result(), index) };
}

function ofObject(object) {
  const name = view().names[object];
  return { kind: "object", name, title: name, rows: result().objects[object].rows, objects: [object] };
}

/** Find in the result that is shown now what was selected in another. */
function found({ kind, name }) {
  const index = kind === "row" ? result().rows.findIndex((row) => row.name === name) : view().names.indexOf(name);
  return kind === null || index < 0 ? nothing() : kind === "row" ? ofRow(index) : ofObject(index);
}

function select(selection) {
  state.selection = selection;
  drawMarks();
  if (selection.rows.every((index) => document.querySelector(`[data-row="${index}"]`))) markSelected(selection.rows);
  else drawTable();
  drawDetail(results, state.current, view(), selection);
  remember();
  byId("clear")?.addEventListener("click", () => { select(nothing()); byId("picture").focus({ preventScroll: true }); });
}

const isSelected = (kind, name) => state.selection.kind === kind && state.selection.name === name;

function selectRow(index) {
  select(isSelected("row", result().rows[index].name) ? nothing() : ofRow(index));
  // On a phone the details may cover it.
  if (state.selection.kind !== null && !isWide()) document.querySelector(`[data-row="${index}"]`).scrollIntoView({ block: "nearest" });
}

const isWide = () => window.matchMedia("(min-width: 60rem)").matches;

function selectObject(object) {
  if (object === null || isSelected("object", view().names[object])) {
    select(nothing());
    return;
  }
  select(ofObject(object));
  announce(object);
  // Beside the picture the table follows; on a phone the details may cover what was touched.
  const wanted = isWide() ? document.querySelector('#rows [aria-selected="true"]') : byId("picture");
  wanted?.scrollIntoView({ block: "nearest" });
}

function previewRow(index) {
  hover(index === null ? [] : objectsOf(result(), index));
}

function hover(objects) {
  if (objects.join() === state.hovered.join()) return;
  state.hovered = objects;
  drawOutlines();
}

function sortBy(by) {
  state.sort = { by, reversed: state.sort.by === by && !state.sort.reversed };
  drawTable();
  remember();
  document.querySelector(`[data-sort="${by}"]`).focus();
}

// --------------------------------------------------------------------------------------------- the picture

/** Return the object that a pixel shows, on either side of the split; null if the chosen result does not show it. */
function objectUnder(pixel) {
  const other = otherResult();
  const isLeft = 100 * (pixel.x + 0.5) < Number(byId("split").value) * view().width;
  const isOther = other && isLeft !== (results.indexOf(other) > state.current);
  const seen = views[(isOther ? other : result()).view];
  const object = objectAt(seen, pixel);
  if (seen === view() || object === null) return object;
  const index = view().names.indexOf(seen.names[object]);
  return index < 0 ? null : index;
}

function pointAt(pixel, x, y) {
  const object = pixel && objectUnder(pixel);
  hover(object === null ? [] : [object]);
  const tip = byId("tip");
  tip.hidden = object === null;
  if (object === null) return;
  if (tip.dataset.object !== `${state.current} ${object}`) {
    tip.replaceChildren(...tipOf(result(), view(), object));
    tip.dataset.object = `${state.current} ${object}`;
  }
  placeTip(tip, x, y);
}

function leave() {
  hover([]);
  byId("tip").hidden = true;
  byId("pointer").hidden = true;
}

function movePointer(event) {
  const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
  const { width, height } = view();
  const at = state.pointer ?? { x: width >> 1, y: height >> 1 };
  if (steps) {
    const stride = event.shiftKey ? 1 : Math.max(1, Math.round(width / 64));
    const clamp = (value, top) => Math.max(0, Math.min(top - 1, value));
    state.pointer = { x: clamp(at.x + stride * steps[0], width), y: clamp(at.y + stride * steps[1], height) };
    showPointer();
  } else if (event.key === "Enter" || event.key === " ") {
    selectObject(objectUnder(at));
  } else {
    return;
  }
  event.preventDefault();
}

function showPointer() {
  const { width, height } = view();
  const { x, y } = state.pointer;
  const box = byId("picture").getBoundingClientRect();
  const mark = byId("pointer");
  mark.hidden = false;
  mark.style.left = `${(100 * (x + 0.5)) / width}%`;
  mark.style.top = `${(100 * (y + 0.5)) / height}%`;
  pointAt(state.pointer, box.left + (box.width * (x + 0.5)) / width, box.top + (box.height * (y + 0.5)) / height);
  const object = objectUnder(state.pointer);
  if (object !== null) announce(object);
}

function announce(object) {
  const rows = result().objects[object].rows.slice(0, 3).map((index) => result().rows[index]);
  byId("announcement").textContent = [view().names[object], ...rows.map((row) => `${row.label}, ${result().ranked.toLowerCase()} ${withError(row.written)}`)].join("; ");
}

// ---------------------------------------------------------------------------------------- the page's address

const SWITCHES = ["quantity", "scale"];
const BOXES = ["texels", "shared"];

/** Keep what is chosen in the address, so that a link shows the same. */
function remember() {
  const chosenNow = new URLSearchParams();
  if (state.current) chosenNow.set("result", state.current);
  for (const name of SWITCHES) chosenNow.set(name, chosen(name));
  for (const name of BOXES) if (byId(name).checked) chosenNow.set(name, "1");
  if (state.sort.by !== "rank" || state.sort.reversed) chosenNow.set("sort", `${state.sort.by}${state.sort.reversed ? "-" : ""}`);
  if (state.filter) chosenNow.set("filter", state.filter);
  if (state.all) chosenNow.set("all", "1");
  if (state.selection.kind) chosenNow.set(state.selection.kind, state.selection.name);
  try {
    history.replaceState(null, "", `#${chosenNow}`);
  } catch {
    // A page inside another has no address of its own.
  }
}

function recall() {
  const kept = new URLSearchParams(location.hash.slice(1));
  const index = Number(kept.get("result") ?? 0);
  if (Number.isInteger(index) && index >= 0 && index < results.length) state.current = index;
  document.querySelectorAll('[name="result"]')[state.current].checked = true;
  for (const name of SWITCHES) {
    for (const input of document.querySelectorAll(`[name="${name}"]`)) if (input.value === kept.get(name)) input.checked = true;
  }
  for (const name of BOXES) byId(name).checked = kept.has(name);
  const sort = kept.get("sort") ?? "rank";
  const by = sort.replace("-", "");
  if (Object.hasOwn(SORTS, by)) state.sort = { by, reversed: sort.endsWith("-") };
  state.filter = byId("filter").value = kept.get("filter") ?? "";
  state.all = kept.has("all");
  for (const kind of ["row", "object"]) if (kept.has(kind)) state.selection = { ...nothing(), kind, name: kept.get(kind) };
}

// ------------------------------------------------------------------------------------------------ downloads

const download = (name, type, text) => downloadBlob(name, new Blob([text], { type }));

function downloadBlob(name, blob) {
  const link = make("a", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

const MAP_OPACITY = 75; // of an overlay that is not shown

/** The picture with its overlay, without outlines, enlarged to at least 1280 pixels. */
function mapPicture() {
  const factor = Math.max(1, Math.ceil(1280 / view().width));
  const canvas = make("canvas");
  canvas.width = factor * view().width;
  canvas.height = factor * view().height;
  const context = canvas.getContext("2d");
  const opacity = (Number(byId("opacity").value) || MAP_OPACITY) / 100;
  context.filter = `grayscale(${opacity})`;
  context.drawImage(byId("render"), 0, 0, canvas.width, canvas.height);
  context.filter = "none";
  context.imageSmoothingEnabled = false;
  context.globalAlpha = opacity;
  context.drawImage(byId("overlay"), 0, 0, canvas.width, canvas.height);
  return canvas;
}

const BARS = 15;

/** The largest width of texts in a font. */
function widest(texts, font) {
  const pen = make("canvas").getContext("2d");
  pen.font = font;
  return Math.max(0, ...texts.map((text) => pen.measureText(text).width));
}

/** The first rows of the table as bars from a common zero, as SVG. */
function barsText() {
  const rows = result().rows.slice(0, BARS);
  const numbers = rows.map((row) => withError(row.written));
  const title = `${result().title}: ${headline(result())}`;
  const drawn = rows.filter((row) => !row.isLast);
  const top = Math.max(...drawn.map((row) => (row.saliency ?? 0) + (row.error ?? 0))) || 1;
  const signed = result().ranked === "Effect" && drawn.some((row) => row.effect < 0);
  const [width, step] = [420, 24];
  const left = 24 + widest(rows.map((row) => row.label), "13px sans-serif");
  const right = left + width + 16 + widest(numbers, "13px sans-serif");
  const zero = left + (signed ? width / 2 : 0);
  const along = (signed ? width / 2 : width) / top;
  const ink = { "1": "#0072b2", "-1": "#d55e00", "0": "#8c8c8c" };
  const escape = (text) => String(text).replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll(">", "&gt;");
  const lines = rows.map((row, index) => {
    const y = 70 + step * index;
    const value = (signed ? row.effect : row.saliency) ?? 0;
    const end = zero + along * value;
    const reach = along * (row.error ?? 0);
    const bar = `<rect x="${Math.min(zero, end)}" y="${y - 8}" width="${Math.abs(end - zero)}" height="16" fill="${ink[row.sign]}"/>`
      + `<line x1="${end - reach}" x2="${end + reach}" y1="${y}" y2="${y}" stroke="#222"/>`;
    return `<text x="${left - 8}" y="${y + 4}" text-anchor="end">${escape(row.isLast ? `~ ${row.label}` : row.label)}</text>`
      + (row.isLast ? "" : bar)
      + `<text x="${right}" y="${y + 4}" text-anchor="end">${escape(numbers[index])}</text>`;
  });
  const whole = Math.max(right, 12 + widest([title], "15px sans-serif"), 12 + widest([result().axis], "13px sans-serif"));
  return `<svg xmlns="http://www.w3.org/2000/svg" width="${Math.ceil(whole) + 16}" height="${70 + step * rows.length}" font-family="sans-serif" font-size="13">`
    + `<rect width="100%" height="100%" fill="white"/><text x="12" y="22" font-size="15">${escape(title)}</text>`
    + `<text x="12" y="42" fill="#555">${escape(result().axis)}</text>${lines.join("")}</svg>\n`;
}

/** The numbers of all results, in the columns of ``write_csv``. */
function csvText() {
  const most = (count) => Math.max(0, ...results.flatMap((one) => one.rows.map(count)));
  const numbered = (name, count) => Array.from({ length: count }, (_, index) => `${name}_${index + 1}`);
  const padded = (list, count) => Array.from({ length: count }, (_, index) => list?.[index] ?? "");
  const values = most((row) => row.value?.length ?? 0);
  const ranges = most((row) => row.range.length);
  const channels = most((row) => row.total.length);
  const head = [
    "result", "rank", "name", "label", "effect", "effect_error", ...numbered("total", channels), ...numbered("total_error", channels),
    ...numbered("value", values), ...numbered("range", ranges), "caution", "metric", "metric_value", "metric_error", "metric_unit", "metric_caution",
  ];
  const lines = results.flatMap((one) => one.rows.map((row, index) => [
    one.title, index + 1, row.name, row.label, row.effect ?? "", row.effectError ?? "", ...padded(row.total, channels), ...padded(row.totalError, channels),
    ...padded(row.value, values), ...padded(row.range, ranges), row.inDoubt ?? "", one.valueOf, one.value, one.error ?? "", one.unit, one.caution ?? "",
  ]));
  const cell = (one) => (/[",\r\n]/.test(String(one)) ? `"${String(one).replaceAll('"', '""')}"` : String(one));
  return `${[head, ...lines].map((line) => line.map(cell).join(",")).join("\r\n")}\r\n`;
}

function jsonText() {
  const numbers = results.map((one) => ({
    title: one.title,
    metric: { name: one.valueOf, unit: one.unit, value: one.value, standard_error: one.error, caution: one.caution },
    quantity: one.quantity,
    ranking: one.rows.map((row, index) => ({
      rank: index + 1, name: row.name, label: row.label, value: row.value ?? null, range: row.range, effect: row.effect, effect_error: row.effectError,
      total: row.total, total_error: row.totalError.length ? row.totalError : null,
      caution: row.inDoubt,
    })),
    info: one.info,
  }));
  const { change, error, values } = data.comparison ?? {};
  const comparison = data.comparison && {
    change, standard_error: error, values: Object.fromEntries(values.map((one) => [one.name, one.values.map(({ value }) => value)])),
  };
  return `${JSON.stringify(comparison ? { comparison, results: numbers } : { results: numbers }, null, 1)}\n`;
}

// ------------------------------------------------------------------------------------------------- start-up

function drawResults() {
  const choices = results.map((one, index) => {
    const input = make("input", { type: "radio", name: "result", value: index, checked: index === 0 });
    input.addEventListener("change", () => { state.current = index; leave(); drawResult(); remember(); });
    return make("label", { class: "result" }, input, make("span", { class: "result-face" },
      make("span", {}, make("span", { class: "result-title" }, one.title), one.title.includes(one.metric) ? null : make("span", { class: "result-metric" }, ` · ${one.metric}`)),
      make("span", { class: "result-value" }, headline(one)),
      ...cautionsOf(one),
      ...[one.verdict, ...one.premises].filter((text) => text && !isCaution(text)).map((text) => make("span", { class: "result-verdict" }, text))));
  });
  byId("results").replaceChildren(...choices);
  byId("results").classList.toggle("single", results.length === 1);
  byId("heading").textContent = data.heading;
}

const LISTED = 6;

/** The change from the first result to the second, and the values that differ. */
function drawComparison({ written, unit, notes, values }) {
  const [before, after] = results;
  const head = make("div", {}, make("p", { class: "result-title" }, `change: ${before.title} → ${after.title}`),
    make("p", { class: "result-value" }, [minus(written), unit].filter(Boolean).join(" ")));
  const listed = values.slice(0, LISTED).map(({ label, texture, values: [from, to] }) => make("div", {}, make("dt", {}, ...breakable(label)),
    make("dd", {}, valueOf({ ...from, texture }), make("span", { class: "to" }, " → "), valueOf({ ...to, texture }))));
  const more = values.length > LISTED ? make("p", { class: "muted" }, `and ${counted(values.length - LISTED, "parameter")} more`) : null;
  byId("comparison").hidden = false;
  byId("comparison").append(head, make("div", {}, make("dl", {}, ...listed), ...[more].filter(Boolean)),
    make("div", { class: "notes-of-change" }, ...notes.map((text) => make("p", { class: "result-verdict" }, text))));
}

/** The effects of both results beside each other. */
function drawChanges({ caption, columns, rows, notes }) {
  const head = columns.map((text) => make("th", { scope: "col" }, text));
  const body = rows.map(([name, ...numbers]) => make("tr", {}, make("th", { scope: "row" }, ...breakable(name)), ...numbers.map((text) => make("td", {}, text))));
  const table = make("table", {}, make("thead", {}, make("tr", {}, ...head)), make("tbody", {}, ...body));
  byId("changes").hidden = false;
  byId("changes").append(make("h2", {}, "How the effects change"), make("p", { class: "result-verdict" }, caption), make("div", { class: "wide", tabindex: "0" }, table),
    ...notes.map((text) => make("p", { class: "result-verdict" }, text)));
}

function listen() {
  const picture = byId("picture");
  picture.addEventListener("pointermove", (event) => {
    if (event.pointerType !== "touch") pointAt(pixelAt(picture, view(), event.clientX, event.clientY), event.clientX, event.clientY);
  });
  picture.addEventListener("pointerleave", leave);
  picture.addEventListener("blur", leave);
  picture.addEventListener("click", (event) => {
    const pixel = pixelAt(picture, view(), event.clientX, event.clientY);
    if (pixel) selectObject(objectUnder(pixel));
  });
  picture.addEventListener("keydown", movePointer);
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape" && event.target !== byId("filter")) { leave(); select(nothing()); }
  });
  byId("opacity").addEventListener("input", drawOpacity);
  byId("split").addEventListener("input", drawSplit);
  const repaint = () => { drawOverlay(); remember(); };
  for (const name of BOXES) byId(name).addEventListener("change", repaint);
  for (const input of document.querySelectorAll('[name="quantity"], [name="scale"]')) input.addEventListener("change", repaint);
  byId("filter").addEventListener("input", () => { state.filter = byId("filter").value; drawTable(); remember(); });
  byId("more").addEventListener("click", () => { state.all = true; drawTable(); remember(); byId("rows").children[FIRST_ROWS].focus({ preventScroll: true }); });
  byId("png").addEventListener("click", () => mapPicture().toBlob((blob) => downloadBlob("map.png", blob)));
  byId("svg").addEventListener("click", () => download("effects.svg", "image/svg+xml", barsText()));
  byId("csv").addEventListener("click", () => download("attributions.csv", "text/csv", csvText()));
  byId("json").addEventListener("click", () => download("attributions.json", "application/json", jsonText()));
  window.addEventListener("beforeprint", drawPrinted);
  window.addEventListener("afterprint", () => byId("printed").replaceChildren());
  window.addEventListener("hashchange", () => location.reload());
  new ResizeObserver(drawOutlines).observe(picture);
}

function followTheme() {
  const system = window.matchMedia("(prefers-color-scheme: dark)");
  let wanted = null;
  const isDark = () => (wanted === null ? system.matches : wanted === "dark");
  const show = () => {
    document.documentElement.style.colorScheme = isDark() ? "dark" : "light";
    byId("theme").textContent = isDark() ? "Light" : "Dark";
    byId("theme").setAttribute("aria-label", isDark() ? "Switch to light colours" : "Switch to dark colours");
  };
  byId("theme").addEventListener("click", () => { wanted = isDark() ? "light" : "dark"; show(); });
  system.addEventListener("change", show);
  show();
}

async function start() {
  followTheme();
  try {
    views = await Promise.all(data.views.map(readView));
    texels = await Promise.all(results.map((one) => readTexels(one.texels)));
  } catch (error) {
    byId("problem").hidden = false;
    byId("problem").textContent = `This browser cannot read the report (${error.message}). A newer one can.`;
    return;
  }
  drawResults();
  if (data.comparison) drawComparison(data.comparison);
  if (data.comparison?.effects) drawChanges(data.comparison.effects);
  recall();
  // Two plain pictures are compared first; the maps come with their slider.
  if (otherResult()) byId("opacity").value = 0;
  listen();
  drawResult();
  document.documentElement.dataset.ready = "";
}

start();
