// What the page was given, and how its numbers become places on a scale.

const data = JSON.parse(document.getElementById("data").textContent);

const byId = (id) => document.getElementById(id);

/** Make an element. Strings become text, never markup: names come from scenes that anyone may have written. */
function make(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "class") made.className = value;
    else if (value !== null && value !== undefined && value !== false) made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

// After a dot or an underscore, and before a capital; never within a number.
const BREAKS = /(?<=[_:/]|(?<!\d)\.|\.(?!\d))|(?<=[a-z])(?=[A-Z])/;

/** Let a long name break where it says something whole, if it does not fit on a line. */
function breakable(text) {
  return text.split(/(\s+)/).map((word) => {
    const parts = word.split(BREAKS);
    return parts.length < 2 ? word : make("span", { class: "word" }, ...parts.flatMap((part, index) => (index ? [make("wbr"), part] : [part])));
  });
}

const bytesOf = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

async function inflate(text) {
  const stream = new Blob([bytesOf(text)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

/** Which objects each pixel shows: planes of indices and of weights in 255ths, the largest first. */
async function readView(view) {
  const [objects, weights] = await Promise.all([inflate(view.objects), inflate(view.weights)]);
  return { ...view, objects: new Uint16Array(objects), weights: new Uint8Array(weights) };
}

/** The maps that show textures texel by texel, of values from 0 or -1 to 1; null where there are none. */
async function readTexels(texels) {
  if (!texels) return null;
  const [magnitude, signed] = await Promise.all([inflate(texels.magnitude), inflate(texels.signed)]);
  return {
    largest: texels.largest,
    magnitude: Float32Array.from(new Uint8Array(magnitude), (root) => (root / 255) ** 4),
    signed: Float32Array.from(new Uint8Array(signed), (root) => Math.sign(root - 128) * ((root - 128) / 127) ** 4),
  };
}

const colours = Object.fromEntries(Object.entries(data.maps).map(([scale, text]) => [scale, bytesOf(text)]));

const DECADES = 3; // powers of ten that a logarithmic scale spans, as in figures

/** Return a share of the largest value, from 0 to 1, on the scales of figures and exported maps. */
const SCALES = {
  sqrt: Math.sqrt,
  linear: (share) => share,
  log: (share) => (share > 0 ? Math.max(0, 1 + Math.log10(share) / DECADES) : 0),
};

/** Return where on a scale from 0 to 1 a value lies; a signed scale has its zero in the middle. */
function placeOf(value, { largest, signed, kind }) {
  const along = SCALES[kind](largest > 0 ? Math.min(Math.abs(value) / largest, 1) : 0);
  return signed ? (1 + Math.sign(value) * along) / 2 : along;
}

/** Return the values at which a scale is labelled: round ones. */
function tickValues(scale) {
  const { largest } = scale;
  if (!(largest > 0)) return [0];
  const top = Math.floor(Math.log10(largest));
  const ones = [];
  if (scale.kind === "log") {
    for (let power = top; power > Math.log10(largest) - DECADES + 0.1; power -= 1) ones.push(10 ** power);
    if (!scale.signed && Math.log10(largest) - top > 0.35) ones.push(largest);
  } else if (scale.kind === "sqrt") {
    const gap = scale.signed ? 0.3 : 0.15;
    let last = 1 + gap;
    for (const value of [top, top - 1, top - 2].flatMap((power) => [5, 2, 1].map((digit) => digit * 10 ** power))) {
      const along = Math.sqrt(value / largest);
      if (along > 1.001 || along > last - gap || along < gap) continue;
      ones.push(value);
      last = along;
    }
    if (!scale.signed) ones.push(0);
  } else {
    const step = 10 ** top * (largest / 10 ** top >= 5 ? 2 : largest / 10 ** top >= 2 ? 1 : 0.5);
    const wide = scale.signed && largest / step > 2.99 ? 2 * step : step;
    for (let value = wide; value <= largest * 1.001; value += wide) ones.push(value);
    if (!scale.signed) ones.push(0);
  }
  const all = scale.signed ? [0, ...ones, ...ones.map((one) => -one)] : ones;
  return all.sort((a, b) => a - b);
}

/** Write a number shortly, with a true minus sign. */
function brief(value, digits = 2) {
  const size = Math.abs(value);
  const plain = size === 0 || (size >= 1e-3 && size < 1e5);
  if (!plain) return minus(value.toExponential(1).replace(".0e", "e").replace("e+", "e"));
  const text = value.toPrecision(digits);
  return minus(digits > 2 && size > 0 && size < 100 ? text : String(Number(text)));
}

const minus = (text) => text.replaceAll("-", "−");

/** The first few of some labels, and how many more there are. */
const firstFew = (labels) => labels.slice(0, 3).join("; ") + (labels.length > 3 ? ` and ${labels.length - 3} more` : "");

const counted = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;

/** ``0.0978 ± 0.0008`` from its two parts. */
const withError = ([value, error]) => (error ? `${minus(value)} ± ${error}` : minus(value));

/** Return the value of a parameter as a colour swatch and numbers, or null where it is not known. */
function valueOf(row) {
  if (row.members) return make("span", { class: "muted" }, counted(row.members.length, "parameter"));
  if (!row.valueWritten) return null;
  const parts = row.texture ? [make("span", { class: "muted mean" }, "mean ")] : [];
  if (row.swatch) {
    const swatch = make("span", { class: "swatch", "aria-hidden": "true" });
    swatch.style.backgroundColor = row.swatch;
    parts.unshift(swatch);
  }
  const all = row.valueWritten;
  const same = all.length === 3 && all.every((one) => one === all[0]);
  const text = same ? all[0] : all.length > 4 ? `${all.slice(0, 3).join("  ")} …` : all.join("  ");
  return make("span", { class: "value" }, ...parts, minus(text));
}

const SIGNS = { "1": ["▲", "raises"], "-1": ["▼", "lowers"], "0": ["◆", "unclear"] };

/** Say what a sign means: raising a parameter raises the metric, or its being there adds to it. */
function signWords(result, sign, row) {
  const words = { "1": result.signs[0], "-1": result.signs[1], "0": "sign lost in the noise" }[sign];
  // The effect of a pose is that of the direction in which it is largest: nothing is raised.
  return row?.isVector ? words.replace("raising it", "moving it in this direction") : words;
}

/** A mark that says a parameter's sign by shape and by colour; variances and the like have none. */
function signMark(row, result) {
  if (!result.signs) return null;
  if (!row.saliency || row.isLast) return make("span", { class: "sign" });
  const [mark, kind] = SIGNS[row.sign];
  const words = signWords(result, row.sign, row);
  return make("span", { class: `sign ${kind}`, title: words, role: "img", "aria-label": words }, mark);
}

/**
 * The signs that the table of the terminal has too: Σ for a texture's total, ! for a derivative known to be off,
 * ? for an error bar that cannot be trusted, unless that holds for all, ~ for an effect that may be read for something else.
 */
function markOf(row, result) {
  const marks = [];
  if (row.texture) marks.push(make("abbr", { class: "mark", title: "totals over the texels, vertices or faces, and their mean value" }, "Σ"));
  if (row.caution !== null) marks.push(make("abbr", { class: "mark caution", title: result.cautions[row.caution] }, cautionMark(row.caution, result)));
  if (row.doubt !== null && !isShared(row.doubt, result)) marks.push(make("abbr", { class: "mark caution", title: result.doubts[row.doubt] }, "?"));
  if (row.rangeNotes.length) marks.push(make("abbr", { class: "mark", title: row.rangeNotes.map((note) => result.rangeNotes[note]).join("; ") }, "~"));
  return marks;
}

/** Whether a doubt holds for every row, so that it need not be said of each. */
const isShared = (doubt, result) => result.rows.every((row) => row.doubt === doubt);
const cautionMark = (index, result) => (result.cautions.length > 1 ? `!${index + 1}` : "!");
