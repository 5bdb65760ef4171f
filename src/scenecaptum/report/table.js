// The table: sorted, filtered, and walked through with the keyboard.

const SORTS = {
  rank: (row, index) => index,
  label: (row) => row.label.toLowerCase(),
  saliency: (row) => (row.isLast ? 2 : -(row.saliency ?? -1)),
  gradient: (row) => -row.total.reduce((sum, one) => sum + (one ?? 0), 0),
};

/** Return the indices of the rows to show, in order. */
function arrangedRows(result, view, sort, wanted) {
  const words = wanted.toLowerCase().split(/\s+/).filter(Boolean);
  const shown = result.rows.map((_, index) => index).filter((index) => {
    const text = searchable(result, view, index);
    return words.every((word) => text.includes(word));
  });
  const keys = result.rows.map(SORTS[sort.by]);
  const order = (a, b) => (keys[a] < keys[b] ? -1 : keys[a] > keys[b] ? 1 : 0);
  return shown.sort((a, b) => (sort.reversed ? -order(a, b) : order(a, b)) || a - b);
}

const FIRST_ROWS = 15;

/** Return the first rows and those that are selected: a long table is a list to look things up in. */
function firstRows(arranged, selected) {
  return arranged.filter((index, place) => place < FIRST_ROWS || selected.includes(index));
}

function searchable(result, view, index) {
  const row = result.rows[index];
  return [row.label, row.name, ...objectsOf(result, index).map((one) => view.names[one])].join(" ").toLowerCase();
}

/** Return the visible objects that show a row's parameter. */
function objectsOf(result, index) {
  if (!result.shownBy) {
    result.shownBy = result.rows.map(() => []);
    result.objects.forEach((one, object) => one.rows.forEach((row) => result.shownBy[row].push(object)));
  }
  return result.shownBy[index];
}

function drawColumns(result, sort, choose) {
  const axes = ["R G B", "x y z"].filter((letters) => result.rows.some((row) => lettersOf(row) === letters));
  const name = result.quantity.charAt(0).toUpperCase() + result.quantity.slice(1);
  const ranked = result.rankedUnit ? `${result.ranked} (${result.rankedUnit})` : result.ranked;
  const columns = [["rank", "#"], ["label", "Parameter"], ["saliency", ranked], ["gradient", axes.length ? `${name} (${axes.join(" or ")})` : name]];
  byId("columns").replaceChildren(...columns.map(([by, text]) => {
    const direction = sort.by === by ? (sort.reversed !== (by === "saliency" || by === "gradient") ? "descending" : "ascending") : "none";
    const arrow = make("span", { class: "arrow", "aria-hidden": "true" }, { ascending: "↑", descending: "↓", none: "" }[direction]);
    const button = make("button", { type: "button", "data-sort": by }, text, arrow);
    button.addEventListener("click", () => choose(by));
    return make("th", { class: by, scope: "col", "aria-sort": direction }, button);
  }));
}

/** Whether a result has anything to rank and to paint: a rating of 0 without a glare source has not. */
const hasEffects = (result) => result.rows.some((row) => row.saliency !== 0 || row.error);

function drawRows(result, shown, handlers) {
  const rows = hasEffects(result) ? shown.map((index) => drawRow(result, index, handlers)) : [];
  byId("rows").replaceChildren(...rows);
  if (rows.length) rows[0].tabIndex = 0;
  else {
    const without = result.jumps.length ? "No effect is ranked." : "No parameter has an effect.";
    const none = hasEffects(result) ? "No parameter matches the filter." : without;
    byId("rows").append(make("tr", { class: "none" }, make("td", { colspan: 4 }, none)));
  }
  byId("count").textContent = shown.length === result.rows.length ? `${shown.length}` : `${shown.length} of ${result.rows.length}`;
}

function drawRow(result, index, handlers) {
  const row = result.rows[index];
  const seen = objectsOf(result, index).length > 0;
  const line = make("tr", { "data-row": index, tabindex: -1, "aria-selected": "false" },
    make("td", { class: "rank" }, String(index + 1)),
    make("th", { class: "label", scope: "row", title: row.name },
      make("div", {}, ...breakable(row.label), ...markOf(row, result), seen || row.isCamera ? null : make("span", { class: "tag" }, row.seenThrough ? "behind glass or mirrored" : "not in view")), valueOf(row)),
    make("td", { class: "saliency" }, row.saliency && !row.isLast ? drawBar(row, result) : null, make("span", { class: "number" }, ...numberOf(row, result))),
    make("td", { class: "gradient" }, ...channelsOf(row)));
  line.addEventListener("click", () => handlers.select(index));
  line.addEventListener("pointerenter", (event) => event.pointerType === "mouse" && handlers.preview(index));
  line.addEventListener("pointerleave", () => handlers.preview(null));
  line.addEventListener("focus", () => { walkTo(line); handlers.preview(index); });
  line.addEventListener("blur", () => handlers.preview(null));
  line.addEventListener("keydown", (event) => rowKey(event, line, () => handlers.select(index)));
  return line;
}

/** The number of a row and its error, which may stand below it in a narrow table: neither breaks. */
function numberOf(row, result) {
  const [value, error] = withError(row.written).split(" ± ");
  const parts = [make("span", { class: "whole" }, signMark(row, result), value)];
  return error === undefined ? parts : [...parts, " ", make("span", { class: "whole" }, `± ${error}`)];
}

/** Return what the three numbers of a row are: channels of a colour or, of a pose, along the axes; else nothing. */
function lettersOf(row) {
  return row.channels === 3 ? (row.isVector ? "x y z" : "R G B") : "";
}

function channelsOf(row) {
  if (row.channels > 4 || row.total.length === 0) return [make("span", { class: "muted" }, `${row.channels} numbers`)];
  const written = (value) => (value === null ? "–" : value > 0 ? `+${brief(value, 3)}` : brief(value, 3));
  return row.total.map((value) => make("span", {}, written(value)));
}

/** A bar as long as the saliency, with a whisker of one standard error to either side; the longest fits. */
function drawBar(row, result) {
  const drawn = result.rows.filter((one) => one.saliency && !one.isLast);
  const top = Math.max(...drawn.map((one) => one.saliency + (one.error ?? 0))) || 1;
  const percent = (value) => `${100 * Math.max(0, Math.min(1, value / top))}%`;
  const bar = make("span", { class: `bar ${SIGNS[row.sign][1]}` });
  const whisker = make("span", { class: "whisker" });
  bar.style.width = percent(row.saliency ?? 0);
  whisker.style.left = percent((row.saliency ?? 0) - (row.error ?? 0));
  whisker.style.right = `calc(100% - ${percent((row.saliency ?? 0) + (row.error ?? 0))})`;
  return make("span", { class: "track", "aria-hidden": "true" }, bar, row.error ? whisker : null);
}

/** One row at a time takes part in the order of the Tab key; the arrows go from there. */
function walkTo(line) {
  for (const other of byId("rows").querySelectorAll('[tabindex="0"]')) other.tabIndex = -1;
  line.tabIndex = 0;
}

function rowKey(event, line, select) {
  const rows = [...byId("rows").children];
  const here = rows.indexOf(line);
  const to = { ArrowDown: here + 1, ArrowUp: here - 1, Home: 0, End: rows.length - 1, PageDown: here + 10, PageUp: here - 10 }[event.key];
  if (to !== undefined) rows[Math.max(0, Math.min(rows.length - 1, to))].focus();
  else if (event.key === "Enter" || event.key === " ") select();
  else return;
  event.preventDefault();
}

function markSelected(rows) {
  for (const line of byId("rows").querySelectorAll("[data-row]")) {
    line.setAttribute("aria-selected", String(rows.includes(Number(line.dataset.row))));
  }
}

const cautioned = (texts) => texts.map((text) => make("p", {}, make("span", { class: "mark caution" }, "!"), ` ${text}`));

const isCaution = (text) => text.startsWith("caution: ");

/** What puts the whole result in doubt stands with its value, not below the table. */
function cautionsOf({ sampling, premises }) {
  const texts = [...sampling, ...premises].filter(isCaution).map((text) => text.replace("caution: ", ""));
  return texts.map((text) => make("span", { class: "result-caution" }, make("span", { class: "mark caution" }, "!"), ` ${text}`));
}

function drawNotes(result) {
  const notes = [make("p", {}, `${result.ranked}: ${result.axis}`)];
  notes.push(...[...result.groupNotes, ...result.rowNotes].map((text) => make("p", {}, text)));
  notes.push(...result.cautions.map((text, index) => {
    const count = result.rows.filter((row) => row.caution === index).length;
    return make("p", {}, make("span", { class: "mark caution" }, cautionMark(index, result)), ` ${text} (${counted(count, "parameter")})`);
  }));
  notes.push(...result.doubts.map((text, index) => {
    if (isShared(index, result)) return make("p", {}, `all parameters: ${text}`); // No row has a mark.
    const labels = result.rows.filter((row) => row.doubt === index).map((row) => row.label);
    return make("p", {}, make("span", { class: "mark caution" }, "?"), ` ${text} (${firstFew(labels)})`);
  }));
  notes.push(...result.jumps.map((text) => make("p", {}, text)));
  notes.push(...cautioned(result.sceneCautions));
  notes.push(...result.rangeNotes.map((text) => make("p", {}, make("span", { class: "mark" }, "~"), ` ${text}`)));
  notes.push(...result.convergence.map((text) => make("p", {}, text)));
  if (!hasEffects(result)) { // There are no marks and bars to read.
    byId("notes").replaceChildren(...notes);
    return;
  }
  if (result.rows.some((row) => row.texture)) notes.push(make("p", {}, make("span", { class: "mark" }, "Σ"), " totals over the texels, vertices or faces, and their mean value"));
  if (result.signs) {
    notes.push(make("p", {}, ...["1", "-1", "0"].flatMap((sign, index) => [
      index ? "  ·  " : "", make("span", { class: `sign ${SIGNS[sign][1]}` }, SIGNS[sign][0]), signWords(result, sign),
    ])));
  }
  notes.push(make("p", {}, result.rows.some((row) => row.error !== null) ? "± one standard error, also as the whisker of each bar." : result.sampling.find((one) => one.startsWith("no error")) ?? "no error bars"));
  byId("notes").replaceChildren(...notes);
}
