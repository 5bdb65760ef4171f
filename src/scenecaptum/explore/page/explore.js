// The page of an exploration: one module for notebooks, the local server and the offline report.

const QUIET = 100; // ms without a change after which a design is sent
const LATEST = 1000; // ms after which it is sent while a slider still moves
const KNEE = 0.6; // of the tone curve, as in visualization/_tonemap.py
const LAYERS = 3; // objects per pixel
const OPERATORS = { dimmer: "*", offset: "+" }; // of changes, in Python and on the command line
const UNRENDERED =
  "Changes are predicted to first order, not rendered. ± is the noise of the prediction only: a render can differ by more.";
const PARTIAL = "This file has predictions only for the parameters with a slider.";
const UNSTORED = "Designs last until this page is closed: the browser does not store them.";
const NOTABLE = 0.01; // of the largest effect on a metric
const CLEAR = 2; // errors from which a render and its prediction differ

/** Make an element. Strings become text, never markup: names come from scenes that anyone may have written. */
function make(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name === "class")
      made.className = `explore-${value}`; // the page may be part of another
    else if (value === true) made.setAttribute(name, "");
    else if (value !== false && value != null) made.setAttribute(name, value);
  }
  made.append(...children.filter((child) => child != null));
  return made;
}

const button = (text, onclick, attributes = {}) => make("button", { type: "button", onclick, ...attributes }, text);

const minus = (text) => text.replaceAll("-", "−");
const [SMALL, DECIMALS] = [1e-3, 6]; // smaller numbers with more decimals are in scientific notation
const exponent = (number) => Number(number.toExponential(3).split("e")[1]); // after rounding

/** Write a value to the digits that its error leaves: ``["0.0978", "0.0008"]``; as tables do, small ones times 10ⁿ. */
function written(value, error, signed = false) {
  const usable = Number.isFinite(error) && error > 0;
  const last = usable ? (error < 3.55 * 10 ** exponent(error) ? 1 : 0) - exponent(error) : 3 - exponent(value || 1);
  const size = Math.max(Math.abs(value), usable ? error : 0);
  const power = size > 0 && size < SMALL && (size < SMALL / 100 || last > DECIMALS) ? exponent(size) : 0;
  const digits = Math.min(Math.max(last + power, 0), 12);
  const write = (number) => {
    const text = (number / 10 ** power).toFixed(digits).replace(/^-(?=[0.]+$)/, ""); // never −0.0
    if (!power) return minus(text);
    return Number(text) ? minus(`${text}e${power}`) : "0"; // no power of ten of zero
  };
  const text = write(value);
  return [signed && value > 0 && /[1-9]/.test(text.split("e")[0]) ? `+${text}` : text, usable ? write(error) : ""];
}

const withError = (value, error, signed) => written(value, error, signed).filter(Boolean).join(" ± ");
const short = (number) => Number(number.toPrecision(6));

/** Write where a slider stands. */
function placeText(form, place) {
  if (form === "dimmer") return `${Math.round(100 * place[0])} %`;
  const numbers = place.map((one) => Number(one.toPrecision(3)));
  if (form === "offset") return numbers[0] ? minus(`${numbers[0] > 0 ? "+" : ""}${numbers[0]}`) : "±0"; // of a texture
  return minus(numbers.join(["vector", "channels"].includes(form) ? "\n" : "  ")); // one beside each of three sliders
}

const bytesOf = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

async function inflate(text) {
  const stream = new Blob([bytesOf(text)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

let halves = null;

/** Decode numbers of half precision, times a factor. */
function decode({ buffer, byteOffset = 0, byteLength }, scale) {
  if (!halves) {
    halves = Float32Array.from({ length: 65536 }, (_, bits) => {
      const [sign, power, rest] = [bits >> 15 ? -1 : 1, (bits >> 10) & 31, bits & 1023];
      return sign * (power ? 2 ** (power - 15) * (1 + rest / 1024) : rest * 2 ** -24);
    });
  }
  const bits = new Uint16Array(buffer.slice(byteOffset, byteOffset + byteLength)); // a copy: an offset may be odd
  const numbers = new Float32Array(bits.length);
  for (let index = 0; index < bits.length; index += 1) numbers[index] = scale * halves[bits[index]];
  return numbers;
}

const STEPS = 16384;
const SRGB = Uint8ClampedArray.from({ length: STEPS + 1 }, (_, step) => {
  const x = step / STEPS;
  return 255 * (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);
});

/** Map linear radiance to pixels as figures do: linear up to a knee, then a shoulder for the largest channel. */
function toneMap(linear, exposure, pixels) {
  for (let from = 0, to = 0; from < linear.length; from += 3, to += 4) {
    const red = Math.max(linear[from] * exposure, 0);
    const green = Math.max(linear[from + 1] * exposure, 0);
    const blue = Math.max(linear[from + 2] * exposure, 0);
    const peak = Math.max(red, green, blue);
    let factor = STEPS;
    if (peak > KNEE) {
      const over = (peak - KNEE) / (1 - KNEE);
      factor *= (KNEE + ((1 - KNEE) * over) / (1 + over)) / peak;
    }
    pixels[to] = SRGB[(red * factor + 0.5) | 0];
    pixels[to + 1] = SRGB[(green * factor + 0.5) | 0];
    pixels[to + 2] = SRGB[(blue * factor + 0.5) | 0];
    pixels[to + 3] = 255;
  }
}

/** Return the images that a slider's way adds to a picture, each with its weights in the three channels. */
function termsOf(slider, from, to) {
  const way = to.map((number, index) => number - from[index]);
  const all = slider.images.map((image, index) => ({
    image,
    weights: slider.byChannel ? way : Array(3).fill(way[index]),
  }));
  return all.filter(({ weights }) => weights.some(Boolean));
}

/** Add terms to a picture in place, three at a time: that takes little longer than one. */
function add(linear, terms) {
  for (let first = 0; first < terms.length; first += 3) {
    const nothing = { image: terms[first].image, weights: [0, 0, 0] };
    addThree(
      linear,
      [0, 1, 2].map((index) => terms[first + index] ?? nothing),
    );
  }
}

function addThree(linear, terms) {
  const [a, b, c] = terms.map(({ image }) => image);
  const [[redA, greenA, blueA], [redB, greenB, blueB], [redC, greenC, blueC]] = terms.map(({ weights }) => weights);
  for (let red = 0, green = 1, blue = 2; red < linear.length; red += 3, green += 3, blue += 3) {
    linear[red] += redA * a[red] + redB * b[red] + redC * c[red];
    linear[green] += greenA * a[green] + greenB * b[green] + greenC * c[green];
    linear[blue] += blueA * a[blue] + blueB * b[blue] + blueC * c[blue];
  }
}

const toHex = (linear) =>
  `#${linear.map((x) => SRGB[Math.round(STEPS * Math.min(Math.max(x, 0), 1))].toString(16).padStart(2, "0")).join("")}`;
const toLinear = (hex) =>
  [1, 3, 5]
    .map((at) => parseInt(hex.slice(at, at + 2), 16) / 255)
    .map((x) => (x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4));

const same = (a, b) => JSON.stringify(a) === JSON.stringify(b);
const sorted = (design) => Object.fromEntries(Object.entries(design).sort(([a], [b]) => (a < b ? -1 : 1)));

class Page {
  constructor(model, el) {
    Object.assign(this, {
      model,
      el,
      id: Math.random().toString(36).slice(2),
      sliders: new Map(),
      rows: new Map(),
      saved: [],
    });
    Object.assign(this, {
      design: {},
      now: {},
      past: [],
      future: [],
      metric: 0,
      overlay: "off",
      compared: null,
      held: false,
    });
    this.heard = (message, buffers) => this.receive(message, buffers ?? []);
    this.isRecorded = el.dataset.explore === "recorded"; // nothing renders what the sliders set
    el.classList.add("explore");
    el.tabIndex = -1;
    el.addEventListener("keydown", (event) => this.press(event));
    el.addEventListener("keyup", (event) => event.key.toLowerCase() === "b" && this.hold(false));
    this.layout();
    model.on("msg:custom", this.heard);
    model.send({ type: "hello" });
  }

  close() {
    this.model.off?.("msg:custom", this.heard);
    this.model.send({ type: "bye" });
    clearTimeout(this.timer);
  }

  receive(message, buffers) {
    const pictures = (message.scales ?? []).map((scale, index) => decode(buffers[index], scale));
    const taken = { ...message, design: message.design && sorted(message.design), picture: pictures[0] };
    if (["scene", "preview", "base", "rendered"].includes(taken.type)) this[taken.type] = taken;
    this[`take${taken.type[0].toUpperCase()}${taken.type.slice(1)}`]?.(taken, pictures);
    this.draw();
  }

  takeScene(scene) {
    this.parts.title.textContent = scene.name;
    this.parts.cards.replaceChildren(...scene.metrics.map((metric, index) => this.makeCard(metric, index)));
    this.parts.cards.toggleAttribute("data-single", scene.metrics.length < 2);
    const options = Object.entries(scene.parameters).map(([name, label]) => make("option", { value: name }, label));
    this.parts.names.replaceChildren(...options);
    this.parts.picture.style.aspectRatio = `${scene.width} / ${scene.height}`;
    this.el.style.setProperty("--ratio", scene.width / scene.height);
  }

  takeStatus({ text }) {
    this.parts.status.textContent = text;
    this.el.toggleAttribute("data-busy", Boolean(text));
  }

  takeProblem({ text }) {
    this.parts.problem.textContent = text;
    this.parts.problem.hidden = !text;
  }

  takeSlider(message, images) {
    const known = this.sliders.get(message.name);
    const byChannel = message.form === "color" || message.form === "channels";
    const isDerived = message.gradients.length > 0; // a move has no images
    const kept = known && !isDerived ? { images: known.images, gradients: known.gradients } : { images }; // till then
    const slider = { ...message, byChannel, ...kept };
    this.sliders.set(message.name, slider);
    if (!this.rows.has(message.name)) this.makeRow(slider);
    this.rows.get(message.name).toggleAttribute("data-waiting", !slider.gradients.length);
    this.rows
      .get(message.name)
      .querySelectorAll("input, button")
      .forEach((one) => {
        one.disabled = !slider.gradients.length;
      });
    if (images.length) this.takeBase();
  }

  async takeObjects(message) {
    const [objects, weights] = await Promise.all([inflate(message.objects), inflate(message.weights)]);
    this.objects = { ...message, objects: new Uint16Array(objects), weights: new Uint8Array(weights) };
    const options = message.names.map((name, index) => make("option", { value: index }, name));
    this.parts.object.replaceChildren(make("option", { value: "" }, "Object…"), ...options);
    this.drawOverlay();
  }

  takeDesign({ design, origin }) {
    if (origin === this.id && this.greeted) return;
    this.greeted = true;
    if (same(design, this.design)) return;
    this.put(design);
    this.commit();
  }

  takeSaved({ designs, note = "" }) {
    this.saved = designs.map((one) => ({ ...one, design: sorted(one.design) }));
    if (this.compared && !this.saved.some((one) => one.name === this.compared)) this.compared = null;
    this.parts.unstored.textContent = note;
    this.listSaved();
  }

  listSaved() {
    this.parts.saved.replaceChildren(...this.saved.map((one) => this.makeSaved(one)));
  }

  /** Send the design once nothing has changed for a moment, and now and then while a slider moves. */
  schedule() {
    const now = performance.now();
    this.parts.picture.setAttribute("aria-busy", "true");
    this.due ??= now + LATEST;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.sendDesign(), Math.max(0, Math.min(QUIET, this.due - now)));
  }

  sendDesign() {
    this.due = undefined;
    this.greeted = true;
    this.model.send({ type: "design", design: this.design, origin: this.id });
  }

  place(slider, design = this.design) {
    return design[slider.name] ?? slider.start;
  }

  move(slider, place) {
    const { [slider.name]: _, ...others } = this.design;
    const limited = place.map((number) => Math.min(Math.max(number, slider.low), slider.high));
    this.design = same(limited, slider.start) ? others : sorted({ ...others, [slider.name]: limited });
    this.schedule();
    this.draw();
  }

  /** Note the design for undo, after a change that is complete, and say what it does. */
  commit() {
    if (same(this.design, this.now)) return;
    this.past.push(this.now);
    this.future = [];
    this.now = this.design;
    const now = this.base && this.measured(this.metric);
    if (now)
      this.parts.announcement.textContent = `${this.scene.metrics[this.metric].title} ${withError(now.value, now.error)}`;
    this.draw();
  }

  show(design) {
    this.put(design);
    this.schedule();
  }

  /** Move all sliders to a design. */
  put(design) {
    this.design = design;
    for (const slider of this.sliders.values()) this.rows.get(slider.name).place(this.place(slider));
    this.draw();
  }

  undo(from = this.past, to = this.future) {
    if (!from.length) return;
    to.push(this.now);
    this.now = from.pop();
    this.show(this.now);
  }

  /** Compute the predicted picture anew, from the start that is known now. */
  takeBase() {
    if (!this.base) return;
    this.linear = this.base.picture.slice();
    this.applied = new Map();
  }

  /** Bring a picture to a design, changing only what has moved since. */
  follow(linear, applied, design) {
    const terms = [];
    for (const slider of this.sliders.values()) {
      if (!slider.images.length) continue;
      const [from, to] = [applied.get(slider.name) ?? this.place(slider, this.base.design), this.place(slider, design)];
      terms.push(...termsOf(slider, from, to));
      applied.set(slider.name, to);
    }
    add(linear, terms);
    return linear;
  }

  /** Return the change of a metric that a design makes to first order, with its standard error; null if unknown. */
  predict(metric, design, only = null) {
    const totals = new Map(); // replicates of the same render are added before their spread is taken
    let turned = 0;
    for (const slider of only ? [only] : this.sliders.values()) {
      const [from, to] = [this.place(slider, this.base.design), this.place(slider, design)];
      if (same(from, to)) continue;
      if (!slider.gradients.length) return null;
      const { rows, turned: adjoint } = slider.gradients[metric];
      const along = (row) => row.reduce((sum, one, index) => sum + one * (to[index] - from[index]), 0);
      const sums = totals.get(rows.length) ?? rows.map(() => 0);
      totals.set(
        rows.length,
        sums.map((sum, index) => sum + along(rows[index])),
      );
      turned += along(adjoint);
    }
    let [change, variance] = [0, turned ** 2];
    for (const sums of totals.values()) {
      const mean = sums.reduce((a, b) => a + b, 0) / sums.length;
      change += mean;
      variance += sums.reduce((sum, one) => sum + (one - mean) ** 2, 0) / (sums.length * (sums.length - 1));
    }
    return { change, error: Math.sqrt(variance) };
  }

  /** Return what a metric is at the design: as rendered if it has been, or else as predicted. */
  measured(metric) {
    const { value, error } = this.base.metrics[metric];
    const predicted = this.predict(metric, this.design);
    if (same(this.design, this.base.design)) return { ...this.base.metrics[metric], predicted };
    if (!this.isRendered() || this.rendered.rough || this.rendered.base !== this.base.number) {
      if (!predicted) return null;
      const lowest = this.scene.metrics[metric].hasClasses ? 0 : -Infinity; // a line may go below 0, a rating does not
      const changed = value + predicted.change;
      const isImpossible = changed < lowest;
      return { value: Math.max(changed, lowest), error: Math.hypot(error, predicted.error), predicted, isImpossible };
    }
    const confirmed = this.rendered.metrics[metric];
    const [change, changeError] = confirmed.change;
    const off = predicted ? change - predicted.change : 0;
    const errors = off ? Math.abs(off) / Math.hypot(changeError, predicted.error) : 0;
    return { ...confirmed, change: { change, error: changeError }, predicted, off, errors };
  }

  isRendered() {
    return this.rendered && same(this.rendered.design, this.design);
  }

  draw() {
    this.parts.code.hidden ||= !same(this.design, this.copied);
    if (this.frame) return;
    this.frame = requestAnimationFrame(() => {
      this.frame = 0;
      this.drawPicture();
      this.drawMetrics();
      this.drawRows();
    });
  }

  /** Choose what the picture shows, and say so. */
  shown() {
    if (!this.base) return this.preview && { ...this.preview, label: "First picture" };
    if (this.held) {
      const design = this.saved.find((one) => one.name === this.compared)?.design ?? {};
      const picture = this.follow(this.base.picture.slice(), new Map(), design);
      return { ...this.base, picture, label: this.compared ?? "Before" };
    }
    const isStart = same(this.design, this.base.design);
    if (isStart) this.takeBase(); // rounding does not add up
    const picture = this.follow(this.linear, this.applied, this.design);
    if (this.isRendered() && !isStart) {
      return {
        ...this.rendered,
        exposure: this.base.exposure,
        label: this.rendered.rough ? "Rendered roughly" : "Rendered",
      };
    }
    const moves = this.moved().some((one) => !one.images.length);
    return { ...this.base, picture, label: isStart ? "Rendered" : moves ? "Predicted, without moves" : "Predicted" };
  }

  /** Return the sliders that stand elsewhere than at the start. */
  moved() {
    return [...this.sliders.values()].filter((one) => !same(this.place(one), this.place(one, this.base.design)));
  }

  drawPicture() {
    const { picture: frame, render: canvas, badge } = this.parts;
    const shown = this.shown();
    frame.toggleAttribute("data-empty", !shown);
    if (!shown) return;
    const context = canvas.getContext("2d");
    if (this.pixels?.width !== shown.width || this.pixels.height !== shown.height) {
      Object.assign(canvas, { width: shown.width, height: shown.height });
      this.pixels = context.createImageData(shown.width, shown.height);
    }
    toneMap(shown.picture, shown.exposure, this.pixels.data);
    context.putImageData(this.pixels, 0, 0);
    badge.textContent = shown.label;
    frame.setAttribute("aria-busy", String(shown.label !== "Rendered" && !this.held));
  }

  drawMetrics() {
    if (!this.base) return;
    const isStart = same(this.design, this.base.design);
    this.scene.metrics.forEach((metric, index) => {
      const [value, verdict, change, note] = this.parts.cards.children[index].querySelectorAll("[data-part]");
      const now = this.measured(index);
      const unit = metric.unit ? ` ${metric.unit}` : "";
      const relaxed = now && (now.relaxed ?? (this.base.metrics[index].relaxed && "as at the start"));
      value.replaceChildren(
        now ? withError(now.value, now.error) + unit : "…",
        ...(relaxed ? [" ", make("span", { class: "muted", title: relaxed }, "relaxed")] : []),
      );
      const unknown = `class unknown: not ${this.isRecorded ? "" : "yet "}rendered`; // it may be in another class
      verdict.textContent = now ? (now.verdict ?? (metric.hasClasses ? unknown : "")) : "";
      const changed = now && (now.change ?? (isStart ? null : now.predicted));
      const how = now?.change ? "rendered" : this.isRecorded ? "predicted to first order, not rendered" : "predicted";
      const isDoubtful = now?.isImpossible || (!now?.change && this.moved().some((one) => one.isLast[index]));
      change.textContent = changed ? `${withError(changed.change, changed.error, true)}${metric.changeUnit && ` ${metric.changeUnit}`} ${how}${isDoubtful ? " ~ may be far off" : ""}` : "";
      const isOff = now?.errors > CLEAR;
      note.hidden = !isOff;
      note.textContent = isOff
        ? `The prediction was ${withError(now.predicted.change, now.predicted.error, true)}: the render is off by ${written(now.off, Math.abs(now.off) / now.errors, true)[0]}, ${Number(now.errors.toPrecision(2))} standard errors.`
        : "";
    });
    const ofStart = this.base.metrics[this.metric].premises.map((one) => `at the start: ${one}`); // not of a prediction
    const { definition } = this.scene.metrics[this.metric];
    this.parts.premises.textContent = [...(this.measured(this.metric)?.premises ?? ofStart), ...(definition ? [definition] : [])].join("\n");
    this.enable(this.parts.undo, this.past.length > 0);
    this.enable(this.parts.redo, this.future.length > 0);
    this.enable(this.parts.reset, Object.keys(this.design).length > 0);
    this.enable(this.parts.start, !isStart);
  }

  /** Enable a button, or disable it; the page takes its focus, so that keys still reach the page. */
  enable(one, isEnabled) {
    if (!isEnabled && one.matches(":focus")) this.el.focus({ preventScroll: true });
    one.disabled = !isEnabled;
  }

  drawRows() {
    if (!this.base) return;
    const { changeUnit: unit } = this.scene.metrics[this.metric];
    this.parts.heading.textContent = this.sliders.size
      ? `Effect of each over its range, to first order${unit ? `, in ${unit}` : ""}; bold: of your change`
      : "";
    for (const slider of this.sliders.values()) {
      const row = this.rows.get(slider.name);
      const moved = !same(this.place(slider), this.place(slider, this.base.design));
      const own = moved && this.predict(this.metric, this.design, slider);
      const over = slider.effects[this.metric];
      row.toggleAttribute("data-moved", moved);
      row.effect.textContent = own
        ? withError(own.change, own.error, true)
        : over
          ? withError(over[0], over[1], true)
          : "";
      row.effect.title = own ? "effect of this change, to first order" : "effect over its range, to first order";
      row.effect.dataset.sign = Math.sign(own ? own.change : (over?.[0] ?? 0));
      row.number.textContent = placeText(slider.form, this.place(slider));
      const other = this.leads(slider);
      const doubts = slider.doubts[this.metric];
      row.leads.textContent = other === null ? "" : `leads for ${this.scene.metrics[other].title}`;
      row.doubts.textContent = doubts ? `~ ${doubts}` : "";
    }
  }

  /** Return the metric for which a slider was chosen, if it does next to nothing to the one that is shown. */
  leads({ effects, doubts }) {
    const share = (metric) => {
      const all = [...this.sliders.values()].map((one) => Math.abs(one.effects[metric]?.[0] ?? 0));
      return Math.abs(effects[metric]?.[0] ?? 0) / Math.max(...all, 1e-30);
    };
    const isClear = (metric) => Math.abs(effects[metric]?.[0] ?? 0) > CLEAR * (effects[metric]?.[1] ?? 0);
    if (share(this.metric) >= NOTABLE && isClear(this.metric)) return null;
    const others = effects.map((_, metric) => metric).filter((metric) => metric !== this.metric && isClear(metric) && !doubts[metric]);
    const most = Math.max(...others.map(share));
    return most >= NOTABLE ? others.find((metric) => share(metric) === most) : null;
  }

  /** Paint each pixel with the effects of what it shows. */
  drawOverlay() {
    const { overlay: canvas, caption } = this.parts;
    canvas.hidden = this.overlay === "off" || !this.objects;
    caption.textContent = "";
    if (canvas.hidden) return;
    const { width, height, objects, weights, effects, maps } = this.objects;
    const [signed, { changeUnit: unit }] = [this.overlay === "signed", this.scene.metrics[this.metric]];
    const table = bytesOf(maps[this.overlay]);
    const largest = Math.max(...effects[this.metric].map(Math.abs), 1e-30);
    const places = effects[this.metric].map(
      (effect) => Math.sqrt(Math.abs(effect) / largest) * (signed ? Math.sign(effect) : 1),
    );
    Object.assign(canvas, { width, height });
    const context = canvas.getContext("2d");
    const image = context.createImageData(width, height);
    const count = width * height;
    for (let pixel = 0; pixel < count; pixel += 1) {
      let [value, covered] = [0, 0];
      for (let layer = 0; layer < LAYERS; layer += 1) {
        const weight = weights[layer * count + pixel];
        value += weight * places[objects[layer * count + pixel]];
        covered += weight;
      }
      const place = covered ? value / covered : 0;
      const color = 3 * Math.round(255 * (signed ? (1 + place) / 2 : place));
      image.data.set([table[color], table[color + 1], table[color + 2], covered], 4 * pixel);
    }
    context.putImageData(image, 0, 0);
    caption.textContent = `Effects over the ranges of the parameters, added up for each object, up to ${short(Number(largest.toPrecision(2)))}${unit && ` ${unit}`}${signed ? "; blue raises the metric, orange lowers it" : ""}.`;
  }

  layout() {
    const p = {
      title: make("h1"),
      status: make("p", { class: "status", role: "status" }),
      problem: make("p", { class: "problem", role: "alert", hidden: true }),
    };
    this.parts = p;
    p.cards = make("div", { class: "cards", role: "radiogroup", "aria-label": "Metric" });
    p.premises = make("p", { class: "premises" });
    p.render = make("canvas", { class: "render" });
    p.overlay = make("canvas", { class: "overlay", hidden: true, "aria-hidden": "true" });
    p.badge = make("span", { class: "badge", role: "status" });
    p.picture = make(
      "div",
      {
        class: "picture",
        "data-empty": true,
        role: "img",
        "aria-label": "The scene. Choose an object below to get its parameters.",
        onclick: (event) => this.click(event),
      },
      p.render,
      p.overlay,
      p.badge,
    );
    p.caption = make("p", { class: "muted" });
    p.object = make("select", {
      "aria-label": "Object, to get its parameters",
      onchange: (event) => this.choose(event.target.value),
    });
    p.chosen = make("div", { class: "chosen", "aria-live": "polite" });
    const overlay = make("select", {
      "aria-label": "Map over the picture",
      onchange: (event) => {
        this.overlay = event.target.value;
        this.drawOverlay();
      },
    });
    overlay.append(
      ...[
        ["off", "No map"],
        ["signed", "Signed map"],
        ["magnitude", "Map of magnitudes"],
      ].map(([value, text]) => make("option", { value }, text)),
    );
    p.before = button("Before (hold, key B)", () => {}, {
      onpointerdown: () => this.hold(true),
      onpointerup: () => this.hold(false),
      onpointerleave: () => this.hold(false),
    });
    const stage = make("section", { class: "stage", "aria-label": "Picture" }, p.picture);
    const view = make("div", { class: "tools" }, p.before, overlay, p.object);
    p.undo = button("Undo", () => this.undo(), { title: "Ctrl+Z" });
    p.redo = button("Redo", () => this.undo(this.future, this.past), { title: "Ctrl+Shift+Z" });
    p.reset = button("Reset", () => {
      this.show({});
      this.commit();
    });
    p.start = button("Take this as the new start", () => this.model.send({ type: "start" }), { class: "live" });
    p.heading = make("p", { class: "muted" });
    p.list = make("div", { class: "sliders" });
    p.names = make("datalist", { id: `names-${this.id}` });
    p.search = make("input", {
      class: "live",
      type: "search",
      list: p.names.id,
      placeholder: "Add a parameter",
      "aria-label": "Add a parameter by its name",
      autocomplete: "off",
      onchange: (event) => this.add(event.target.value),
    });
    p.saved = make("ul", { class: "saved" });
    p.unstored = make("p", { class: "muted" });
    p.name = make("input", {
      placeholder: "Name of this design",
      "aria-label": "Name of this design",
      maxlength: 60,
      autocomplete: "off",
      onkeydown: (event) => event.key === "Enter" && this.save(),
    });
    p.code = make("textarea", {
      class: "code",
      readonly: true,
      hidden: true,
      rows: 8,
      "aria-label": "Code",
      spellcheck: "false",
    });
    const designs = make(
      "section",
      { class: "designs", "aria-label": "Designs" },
      make("h2", {}, "Designs"),
      make(
        "div",
        { class: "tools" },
        p.name,
        button("Save", () => this.save()),
      ),
      p.saved,
      p.unstored,
      make(
        "div",
        { class: "tools" },
        button("Copy as Python", () => this.copy(this.python())),
        button("Copy as command line", () => this.copy(this.command())),
      ),
      p.code,
    );
    const controls = make(
      "section",
      { class: "controls", "aria-label": "Parameters" },
      make("div", { class: "tools" }, p.undo, p.redo, p.reset, p.start),
      p.heading,
      p.list,
      p.search,
      p.names,
    );
    const left = make("div", { class: "left" }, stage, view, p.caption, p.chosen, designs);
    p.announcement = make("p", { class: "unseen", "aria-live": "polite" });
    this.el.replaceChildren(
      make(
        "header",
        { class: "top" },
        make("div", {}, make("p", { class: "muted" }, "scenecaptum · explore"), p.title),
        p.status,
      ),
      p.problem,
      p.cards,
      p.premises,
      this.isRecorded ? make("p", { class: "unrendered" }, UNRENDERED) : "",
      make("div", { class: "work" }, left, controls),
      p.announcement,
    );
  }

  makeCard(metric, index) {
    const input = make("input", {
      type: "radio",
      name: `metric-${this.id}`,
      checked: index === this.metric,
      onchange: () => {
        this.metric = index;
        this.drawOverlay();
        this.draw();
      },
    });
    const part = (tag, name) => make(tag, { class: name, "data-part": name });
    return make(
      "label",
      { class: "card" },
      input,
      make(
        "span",
        { class: "face" },
        make("span", { class: "title" }, metric.title),
        part("span", "value"),
        part("span", "verdict"),
        part("span", "change"),
        part("span", "warning"),
      ),
    );
  }

  /** Add the controls of a slider; ``place`` moves them. */
  makeRow(slider) {
    const row = make("div", {
      class: "slider",
      role: "group",
      "aria-label": slider.label,
      "data-name": slider.name,
      "data-form": slider.form,
    });
    const moved = (place) => this.move(slider, place);
    const range = (label, low, high, read) =>
      make("input", {
        type: "range",
        min: low,
        max: high,
        step: "any",
        "aria-label": label,
        oninput: read,
        onchange: () => this.commit(),
      });
    const [controls, place] =
      slider.form === "color"
        ? colorControls(slider, range, moved, () => this.commit())
        : numberControls(slider, range, moved);
    row.effect = make("output", { class: "effect" });
    row.number = make("span", { class: "number" });
    row.leads = make("span", { class: "muted" });
    row.doubts = make("p", { class: "muted" });
    const back = button(
      "×",
      () => {
        this.move(slider, slider.start);
        row.place(slider.start);
        this.commit();
      },
      { class: "back", title: "back to the scene's value", "aria-label": `Reset ${slider.label}` },
    );
    row.append(
      make(
        "div",
        { class: "head" },
        make("span", { class: "label", title: slider.name }, slider.label),
        row.leads,
        row.effect,
        back,
      ),
      ...controls,
      row.number,
      row.doubts,
    );
    row.place = place;
    place(this.place(slider));
    this.rows.set(slider.name, row);
    this.parts.list.append(row);
  }

  makeSaved(one) {
    const values = this.scene?.metrics
      .map(
        (metric, index) =>
          one.metrics &&
          `${metric.symbol ?? metric.title} ${withError(one.metrics[index].value, one.metrics[index].error)}`,
      )
      .filter(Boolean)
      .join(", ");
    const compare = button(
      "Compare",
      () => {
        this.compared = this.compared === one.name ? null : one.name;
        this.listSaved();
      },
      { "aria-pressed": String(this.compared === one.name), title: "hold B to see it" },
    );
    return make(
      "li",
      {},
      make("span", { class: "label" }, one.name),
      make("span", { class: "muted" }, values || "not rendered"),
      button("Show", () => {
        this.show(one.design);
        this.commit();
      }),
      compare,
      button("×", () => this.model.send({ type: "forget", name: one.name }), { "aria-label": `Forget ${one.name}` }),
    );
  }

  press(event) {
    if (event.target.matches("input:not([type=range]):not([type=radio]), textarea, select")) return;
    const key = event.key.toLowerCase();
    if (key === "b" && !event.ctrlKey && !event.metaKey) this.hold(true);
    else if (key === "z" && (event.ctrlKey || event.metaKey))
      event.shiftKey ? this.undo(this.future, this.past) : this.undo();
    else return;
    event.preventDefault();
  }

  hold(held) {
    this.held = held;
    this.parts.before.setAttribute("aria-pressed", String(held));
    this.draw();
  }

  click(event) {
    if (!this.objects) return;
    const box = this.parts.picture.getBoundingClientRect();
    const column = Math.floor(((event.clientX - box.left) / box.width) * this.objects.width);
    const line = Math.floor(((event.clientY - box.top) / box.height) * this.objects.height);
    const index = line * this.objects.width + column;
    this.choose(this.objects.weights[index] ? this.objects.objects[index] : "");
  }

  /** Show the parameters of an object: those with a slider to go to, the others to add if something renders them. */
  choose(index) {
    this.parts.object.value = String(index);
    if (index === "") return this.parts.chosen.replaceChildren();
    const all = this.objects.parameters[index];
    const names = this.isRecorded ? all.filter((name) => this.sliders.get(name)?.gradients.length) : all;
    const left = names.length < all.length ? PARTIAL : all.length ? "" : "Nothing of it can be changed.";
    const entry = (name) =>
      button(`${this.rows.has(name) ? "" : "+ "}${this.scene.parameters[name]}`, () => this.add(name));
    this.parts.chosen.replaceChildren(
      make("h2", {}, this.objects.names[index]),
      make("div", { class: "tools" }, ...names.map(entry)),
      make("p", { class: "muted" }, left),
    );
  }

  add(text) {
    const name = this.scene.parameters[text]
      ? text
      : Object.keys(this.scene.parameters).find((one) => this.scene.parameters[one] === text);
    if (!name) return;
    this.parts.search.value = "";
    const row = this.rows.get(name);
    if (!row) return this.model.send({ type: "add", name });
    row.scrollIntoView({ block: "nearest" });
    row.querySelector("input").focus();
  }

  save() {
    const name = this.parts.name.value.trim();
    clearTimeout(this.timer);
    this.sendDesign();
    if (name) this.model.send({ type: "save", name });
    this.parts.name.value = "";
  }

  /** Return the inputs for code: the parameters that differ from those of the scene file; those of the page at rest. */
  changed() {
    const moved = Object.keys(this.design);
    return moved.length ? [...new Set([...this.scene.recipe.changed, ...moved])] : this.scene.recipe.inputs;
  }

  python() {
    const { python, metrics, attribute } = this.scene.recipe;
    const changes = Object.entries(this.design).map(([name, place]) => {
      const { form } = this.sliders.get(name);
      const [key, numbers] = [`values[${JSON.stringify(name)}]`, place.map(short)];
      if (OPERATORS[form]) return `${key} = ${key} ${OPERATORS[form]} ${numbers[0]}`;
      const value = form === "scalar" ? numbers[0] : JSON.stringify(numbers);
      return `${key} = torch.tensor(${value}, dtype=torch.float32)`; // [15,18,22] would be integers
    });
    const inputs = JSON.stringify([...new Set([...this.changed(), ...this.scene.recipe.changed])]); // it sets these
    return [
      python.replace("{inputs}", () => inputs),
      ...changes,
      "renderer.clamp_(values)",
      ...metrics.map((metric) => `print(VanillaSceneGradient(renderer, ${metric}).attribute(${attribute}))`),
      "",
    ].join("\n");
  }

  /** Return the changes of the command that made the page, with those of the design in their place. */
  settings() {
    const settings = new Map(this.scene.recipe.settings.map((one) => [one.name, one]));
    for (const [name, place] of Object.entries(this.design)) {
      const [given, operator] = [settings.get(name), OPERATORS[this.sliders.get(name).form] ?? ""];
      const combine = { "*": (number) => number * place[0], "+": (number) => number + place[0] }[operator];
      if (!given || !combine) settings.set(name, { name, operator, numbers: place });
      else if (["", operator].includes(given.operator)) settings.set(name, { ...given, numbers: given.numbers.map(combine) });
      else settings.set(name + operator, { name, operator, numbers: place }); // a factor and a sum: the command refuses both
    }
    return [...settings.values()];
  }

  command() {
    const quote = (text) => `'${text.replaceAll("'", "'\\''")}'`;
    const inputs = this.changed().map((name) => `--inputs ${quote(name)}`);
    const changes = this.settings().map(
      ({ name, operator, numbers }) => `--set ${quote(`${name}${operator}=${numbers.map(short).join(",")}`)}`,
    );
    return [this.scene.recipe.command, ...inputs, ...changes].join(" \\\n  ") + "\n";
  }

  /** Copy the code of the design, and show it until the design changes. */
  copy(text) {
    this.copied = this.design;
    Object.assign(this.parts.code, { value: text, hidden: false });
    this.parts.code.select();
    navigator.clipboard?.writeText(text).then(
      () => {
        this.parts.announcement.textContent = "Copied";
      },
      () => {},
    );
  }
}

/** A colour, and how bright it is. */
function colorControls(slider, range, moved, commit) {
  let hue = [1, 1, 1];
  const color = make("input", {
    type: "color",
    "aria-label": `${slider.label}, colour`,
    oninput: () => moved(place(toLinear(color.value))),
    onchange: commit,
  });
  const bright = range(`${slider.label}, brightness`, 0, 1, () =>
    moved(set(hue.map((part) => part * Number(bright.value)))),
  );
  const set = (numbers) => {
    color.value = toHex(numbers);
    return numbers;
  };
  const place = (numbers) => {
    const peak = Math.max(...numbers);
    if (peak > 0) hue = numbers.map((number) => number / peak);
    bright.value = peak;
    return set(numbers);
  };
  return [[make("div", { class: "pair" }, color, bright)], place];
}

/** A range for each number. */
function numberControls(slider, range, moved) {
  const names = { channels: ["red", "green", "blue"], vector: ["x", "y", "z"] }[slider.form] ?? [""];
  const ranges = slider.start.map((_, index) =>
    range([slider.label, names[index]].filter(Boolean).join(", "), slider.low, slider.high, () =>
      moved(ranges.map((one) => Number(one.value))),
    ),
  );
  const lines = ranges.map((one, index) =>
    make(
      "div",
      { class: "pair" },
      names[index] ? make("span", { class: "muted", "aria-hidden": "true" }, names[index]) : null,
      one,
    ),
  );
  return [
    lines,
    (numbers) =>
      numbers.forEach((number, index) => {
        ranges[index].value = number;
      }),
  ];
}

function hub() {
  const listeners = [];
  return {
    on: (_, listener) => listeners.push(listener),
    tell: (...message) => listeners.forEach((one) => one(...message)),
  };
}

/** The model of a page of the local server: messages come as events, pictures by their addresses. */
function connect() {
  const { on, tell } = hub();
  const fetched = async (path) => {
    const answer = await fetch(path);
    if (answer.status !== 200) throw new Error("there is a newer picture");
    return new DataView(await answer.arrayBuffer());
  };
  let done = Promise.resolve();
  const events = new EventSource("events");
  events.onmessage = (event) => {
    const message = JSON.parse(event.data);
    const buffers = Promise.all(message.buffers.map(fetched)).catch(() => null); // null: there is a newer message
    done = done.then(async () => {
      const all = await buffers;
      if (all) tell(message, all);
    });
  };
  events.onerror = () => tell({ type: "status", text: "Disconnected: is the server still running?" });
  const send = async (content) => {
    if (content.type === "hello" || content.type === "bye") return; // the events begin with all that is known
    const answer = await fetch("message", { method: "POST", body: JSON.stringify(content) }).catch(() => null);
    if (answer && !answer.ok) tell({ type: "problem", text: (await answer.json()).error });
  };
  return { on, send };
}

/** Return a number for a text that hardly any other text has (FNV-1a). */
function hashOf(text) {
  let hash = 0x811c9dc5;
  for (let index = 0; index < text.length; index += 1) hash = Math.imul(hash ^ text.charCodeAt(index), 0x01000193);
  return hash >>> 0;
}

/** Saved designs that the browser stores under a key; where it refuses, they last until the page is closed. */
function shelf(key) {
  let kept = null; // here, where the browser has refused
  return {
    read() {
      try {
        return kept ?? JSON.parse(localStorage.getItem(key)) ?? [];
      } catch {
        kept = [];
        return kept;
      }
    },
    write(designs) {
      try {
        localStorage.setItem(key, JSON.stringify(designs));
        kept = null;
      } catch {
        kept = designs;
      }
    },
    isRefused: () => kept !== null,
  };
}

/** The model of an offline page: it has all messages, and keeps saved designs in the browser. */
function recorded(text) {
  const { on, tell } = hub();
  const saved = shelf(`scenecaptum ${text.length} ${hashOf(text)}`); // of this content: all files may share a storage
  const tellSaved = () => tell({ type: "saved", designs: saved.read(), note: saved.isRefused() ? UNSTORED : "" });
  const play = async () => {
    for (const { buffers, ...message } of JSON.parse(text)) {
      tell(message, await Promise.all(buffers.map(async (buffer) => new DataView(await inflate(buffer)))));
    }
    tellSaved();
  };
  const keep = ({ name }, more) => {
    saved.write([...saved.read().filter((one) => one.name !== name), ...more]);
    tellSaved();
  };
  let design = {};
  const send = (content) => {
    if (content.type === "hello") play();
    else if (content.type === "design") design = content.design;
    else if (content.type === "save") keep(content, [{ name: content.name, design, metrics: null }]);
    else if (content.type === "forget") keep(content, []);
  };
  return { on, send };
}

export function render({ model, el }) {
  const page = new Page(model, el);
  return () => page.close();
}

export default { render };

const shell = document.querySelector("[data-explore]");
if (shell)
  render({
    model:
      shell.dataset.explore === "server" ? connect() : recorded(document.getElementById("explore-data").textContent),
    el: shell,
  });
