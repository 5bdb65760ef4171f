// The picture: overlay, what is lit up, and the pointer.

const LAYERS = 3;

/** Paint every pixel with the values of what it shows, weighted by how much of it they cover, or of its texels. */
function paintOverlay(canvas, view, result, scale) {
  canvas.width = view.width;
  canvas.height = view.height;
  const context = canvas.getContext("2d");
  const image = context.createImageData(view.width, view.height);
  const table = colours[scale.signed ? "signed" : "magnitude"];
  const values = valuesOf(result, scale);
  const texels = scale.texels && texelsOf(result)?.[scale.signed ? "signed" : "magnitude"];
  const count = view.width * view.height;
  for (let pixel = 0; pixel < count; pixel += 1) {
    let value = 0;
    let covered = 0;
    for (let layer = 0; layer < LAYERS; layer += 1) {
      const weight = view.weights[layer * count + pixel];
      value += weight * values[view.objects[layer * count + pixel]];
      covered += weight;
    }
    if (covered === 0) continue;
    if (texels) value = 255 * texels[pixel] * texelsOf(result).largest;
    const colour = 3 * Math.round(255 * placeOf(value / covered, scale));
    image.data.set([table[colour], table[colour + 1], table[colour + 2], covered], 4 * pixel);
  }
  context.putImageData(image, 0, 0);
}

/** Return what each object is painted with. */
function valuesOf(result, scale) {
  return result.objects.map((one) => (scale.signed ? one.signed : one.magnitude) ?? 0);
}

/** Return how much of each pixel a set of objects covers, in 255ths. */
function coverage(view, objects) {
  const count = view.width * view.height;
  const covered = new Uint8Array(count);
  const wanted = new Uint8Array(view.names.length);
  for (const one of objects) wanted[one] = 1;
  for (let layer = 0; layer < LAYERS; layer += 1) {
    for (let pixel = 0, entry = layer * count; pixel < count; pixel += 1, entry += 1) {
      if (wanted[view.objects[entry]]) covered[pixel] += view.weights[entry];
    }
  }
  return covered;
}

/** Darken everything but the objects that are selected. */
function paintShade(canvas, view, objects) {
  canvas.width = view.width;
  canvas.height = view.height;
  if (objects.length === 0) return;
  const context = canvas.getContext("2d");
  const image = context.createImageData(view.width, view.height);
  coverage(view, objects).forEach((covered, pixel) => {
    image.data[4 * pixel + 3] = 0.68 * (255 - covered);
  });
  context.putImageData(image, 0, 0);
}

/** Collect the sides of pixels at which a set of objects ends; once for each set, since pointers come back. */
function outline(view, objects) {
  const key = objects.join();
  view.outlines ??= new Map();
  if (!view.outlines.has(key)) view.outlines.set(key, traceOutline(view, coverage(view, objects)));
  return view.outlines.get(key);
}

function traceOutline({ width, height }, covered) {
  const path = new Path2D();
  for (let y = 0; y <= height; y += 1) {
    for (let x = 0; x <= width; x += 1) {
      const at = y * width + x;
      const here = x < width && y < height && covered[at] > 127;
      const left = x > 0 && y < height && covered[at - 1] > 127;
      const above = y > 0 && x < width && covered[at - width] > 127;
      if (here !== left) { path.moveTo(x, y); path.lineTo(x, y + 1); }
      if (here !== above) { path.moveTo(x, y); path.lineTo(x + 1, y); }
    }
  }
  return path;
}

/** Draw outlines at the screen's own resolution, bright on dark so that they show on any picture. */
function drawLines(canvas, view, hovered, selected) {
  const ratio = window.devicePixelRatio || 1;
  canvas.width = Math.round(canvas.clientWidth * ratio);
  canvas.height = Math.round(canvas.clientHeight * ratio);
  const context = canvas.getContext("2d");
  const across = canvas.width / view.width;
  const strokes = [[selected, "#ffffff", 2], [hovered, "#7fd4ff", 1.5]];
  for (const [objects, colour, width] of strokes) {
    if (objects.length === 0) continue;
    const path = outline(view, objects);
    context.setTransform(across, 0, 0, canvas.height / view.height, 0, 0);
    context.lineCap = "round";
    for (const [ink, wide] of [["rgba(0, 0, 0, 0.75)", width + 2], [colour, width]]) {
      context.strokeStyle = ink;
      context.lineWidth = (wide * ratio) / across;
      context.stroke(path);
    }
  }
}

/** Draw where moving objects raises the metric, over what drawLines has drawn. */
function drawArrows(canvas, view, arrows) {
  const ratio = window.devicePixelRatio || 1;
  const context = canvas.getContext("2d");
  const [across, down] = [canvas.width / view.width, canvas.height / view.height];
  context.setTransform(1, 0, 0, 1, 0, 0);
  for (const { x, y, dx, dy } of arrows) {
    const [fromX, fromY, toX, toY] = [x * across, y * down, (x + dx) * across, (y + dy) * down];
    const angle = Math.atan2(toY - fromY, toX - fromX);
    const path = new Path2D();
    path.moveTo(fromX, fromY);
    path.lineTo(toX, toY);
    for (const side of [-0.5, 0.5]) {
      path.moveTo(toX, toY);
      path.lineTo(toX - 9 * ratio * Math.cos(angle + side), toY - 9 * ratio * Math.sin(angle + side));
    }
    for (const [ink, width] of [["#ffffff", 4.5], ["#111111", 2]]) {
      context.strokeStyle = ink;
      context.lineWidth = width * ratio;
      context.stroke(path);
    }
  }
}

/** Return the pixel at a place in the window, or null outside the picture. */
function pixelAt(element, view, x, y) {
  const box = element.getBoundingClientRect();
  const column = Math.floor(((x - box.left) / box.width) * view.width);
  const line = Math.floor(((y - box.top) / box.height) * view.height);
  return column < 0 || line < 0 || column >= view.width || line >= view.height ? null : { x: column, y: line };
}

/** Return the object that covers most of a pixel, or null outside a fisheye's circle. */
function objectAt(view, pixel) {
  const index = pixel.y * view.width + pixel.x;
  return view.weights[index] ? view.objects[index] : null;
}

/** Draw the colour bar with round numbers under it. */
function drawScale(result, scale) {
  const canvas = byId("scale");
  const context = canvas.getContext("2d");
  const image = context.createImageData(256, 1);
  const table = colours[scale.signed ? "signed" : "magnitude"];
  for (let place = 0; place < 256; place += 1) {
    image.data.set([table[3 * place], table[3 * place + 1], table[3 * place + 2], 255], 4 * place);
  }
  context.putImageData(image, 0, 0);
  const ticks = tickValues(scale).map((value) => {
    const place = placeOf(value, scale);
    // At the ends a number stands beside its mark, not across the edge.
    const tick = make("span", { class: place > 0.97 ? "last" : place < 0.03 ? "first" : "" }, brief(value));
    tick.style.left = `${100 * place}%`;
    return tick;
  });
  byId("ticks").replaceChildren(...ticks);
  byId("caption").replaceChildren(...captionOf(result, scale));
}

const NEGLIGIBLE = 0.01; // relative to the largest effect

/** What the map leaves neutral though it matters: a window whose sky is seen through its glass, for example. */
function seenOnlyThrough(result) {
  return result.rows.flatMap((row, index) => (row.seenThrough && !objectsOf(result, index).length
    && row.saliency > NEGLIGIBLE * result.rows[0].saliency ? [`${row.label} (#${index + 1})`] : []));
}

function captionOf(result, scale) {
  const axis = result.axis.charAt(0).toUpperCase() + result.axis.slice(1);
  const pointing = result.arrows.length ? ["; arrows: where moving an object raises the metric most"] : [];
  const behind = seenOnlyThrough(result);
  const sentences = [
    behind.length ? `Not on the map, seen only behind glass or mirrored: ${firstFew(behind)}.` : "",
    result.isNoise && !scale.texels ? "No effect on the map stands out from the noise: a colour may be due to chance." : "",
  ].filter(Boolean);
  if (sentences.length) pointing.push(`. ${sentences.join(" ")}`);
  const sign = scale.signed ? ", with the sign of the sum" : "";
  const norm = result.objects.some((one) => one.mapped > 1) ? [`of an object with several: root of the sum of squares${sign}`] : [];
  const meaning = [axis, ...norm, ...(scale.texels && result.texels ? [result.texels.meaning] : [])].join("; ");
  if (!scale.signed) return [meaning, ...pointing];
  const unclear = result.objects.filter((one) => one.magnitude && !one.signed).length;
  if (unclear && !scale.texels) pointing.unshift(`; white: sign lost in the noise (${unclear} ${unclear === 1 ? "object" : "objects"})`);
  return [
    `${meaning}; `,
    make("span", { class: "sign lowers" }, "▼"), `${result.signs[1]}, `, make("span", { class: "sign raises" }, "▲"), result.signs[0],
    ...pointing,
  ];
}
