// The viewer of a film: decode arrays, move corners, draw with Canvas 2-D. No library, no network.
"use strict";
(async () => {
  const element = (name, attributes = {}, ...children) => {
    const made = Object.assign(document.createElement(name), attributes);
    made.append(...children);
    return made;
  };
  const say = (text) => { document.getElementById("status").textContent = text; };
  const film = JSON.parse(document.getElementById("film").textContent);
  const cache = new Map();
  const CRC = Uint32Array.from({ length: 256 }, (_, n) => {
    for (let k = 0; k < 8; k++) n = n & 1 ? 0xedb88320 ^ (n >>> 1) : n >>> 1;
    return n >>> 0;
  });

  // Arrays ------------------------------------------------------------------------------------------------
  async function unpacked(block) {
    if (!block) return null;
    const key = `${block.id} ${block.dtype}`, named = (data) => ({ data, shape: block.shape, scale: block.scale });
    if (cache.has(key)) return named(cache.get(key));
    const text = atob(document.getElementById(block.id).textContent);
    const packed = Uint8Array.from(text, (letter) => letter.charCodeAt(0));
    let raw;
    try {
      const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
      raw = new Uint8Array(await new Response(stream).arrayBuffer());
    } catch (error) {
      throw new Error(`the array ${block.id} of this page is damaged`);
    }
    let sum = 0xffffffff;
    for (let k = 0; k < raw.length; k++) sum = CRC[(sum ^ raw[k]) & 255] ^ (sum >>> 8);
    if (((sum ^ 0xffffffff) >>> 0) !== block.crc32) throw new Error(`the array ${block.id} of this page is damaged`);
    const kind = { int16: Int16Array, int32: Int32Array, float32: Float32Array, uint8: Uint8Array }[block.dtype];
    cache.set(key, new kind(raw.buffer));
    return named(cache.get(key));
  }

  // Page --------------------------------------------------------------------------------------------------
  const cases = element("select", { id: "case" }, ...film.takes.map((take, k) => element("option", { value: k }, take.label)));
  const color = element("select", { id: "color" });
  const play = element("button", { id: "play", type: "button" }, "Play");
  const time = element("input", { id: "time", type: "range", min: 0, step: 1, value: 0 });
  const factor = element("input", { id: "factor", type: "range", min: -1, max: 100, step: 1, value: 50 });
  const clock = element("output", { id: "clock" }), scale = element("output", { id: "scale" });
  const note = element("p", { className: "note", id: "note" });
  const canvas = (name, words) => {
    const made = element("canvas", { className: name, id: name });
    made.setAttribute("role", "img");
    made.setAttribute("aria-label", words);
    return made;
  };
  const scene = canvas("scene", "The bodies in space; arrow keys turn the view, plus and minus change its size");
  scene.tabIndex = 0;
  const image = canvas("image", "Image of the instant, logarithmic");
  const side = element("div", { className: "side" }, image);
  const main = document.getElementById("viewer");
  main.append(
    element("div", { className: "bar" }, element("label", { className: "long" }, "Case", cases), element("label", {}, "Color", color)),
    element("div", { className: "bar" }, play, element("label", { className: "long" }, "Time", time, clock),
      element("label", { className: "long" }, "Exaggeration", factor, scale)),
    note, element("div", { className: "views" }, scene, side));
  main.hidden = false;
  if (film.takes.length < 2) cases.parentElement.hidden = true;

  // State -------------------------------------------------------------------------------------------------
  const state = { take: null, stage: null, yaw: 0.6, pitch: 0.35, pitch0: 0.35, zoom: 1, playing: false, began: 0, from: 0, curves: [], maps: [] };
  let asked = false;
  const draw = () => { if (!asked) { asked = true; requestAnimationFrame(() => { asked = false; drawAll(); }); } };
  const instant = () => Number(time.value);
  const exaggeration = () => {
    const step = Number(factor.value);
    return step < 0 ? 0 : state.take.factor * 10 ** ((step - 50) / 25);
  };

  async function choose(number) {
    const take = film.takes[number], stage = film.stages[take.stage];
    const [points, faces, body, colors, pivots, axes, terms] = await Promise.all(
      ["points", "faces", "body", "colors", "pivots", "axes", "terms"].map((name) => unpacked(stage[name])));
    const [poses, figures, shapes, weights, planes, images] = await Promise.all(
      ["poses", "figures", "shapes", "weights", "planes", "images"].map((name) => unpacked(take[name])));
    const maps = await Promise.all((take.maps || []).map(async (one) => {
      const [cells, parts, shares] = await Promise.all([unpacked(one.cells), unpacked(one.shapes), unpacked(one.weights)]);
      return { ...one, cells, parts, shares };
    }));
    state.stage = { ...stage, points, faces, body, colors, pivots, axes, terms, count: points.shape[0] };
    state.take = { ...take, poses, figures, shapes, weights, planes, images };
    const n = points.shape[0];
    state.moved = new Float32Array(3 * n); state.value = new Float32Array(n); state.seen = new Float32Array(3 * n);
    frame(points.data, n);
    if (shapes && !poses && state.take0 === undefined) { state.yaw = Math.PI / 2; state.pitch = state.pitch0 = 0.6; }
    state.take0 = number;
    const former = color.value;
    color.replaceChildren(element("option", { value: "body" }, "bodies"));
    if (take.normal) color.append(element("option", { value: "displacement" }, "displacement"));
    if (planes) color.append(element("option", { value: "wavefront" }, "wavefront"));
    color.value = [...color.options].some((option) => option.value === former) && former !== "body" ? former
      : planes ? "wavefront" : take.normal ? "displacement" : "body";
    const still = take.time.length < 2;
    time.max = take.time.length - 1;
    time.value = Math.min(instant(), take.time.length - 1);
    time.disabled = play.disabled = still;
    play.parentElement.hidden = still && !(take.largest > 0);
    factor.disabled = !(take.largest > 0);
    factor.value = take.largest > 0 ? 50 : -1;
    const series = still ? [] : take.series;  // of one instant there is no curve, but a number
    const told = still ? take.series.map((one) => `${one.name[0].toUpperCase()}${one.name.slice(1)}: ${(one.values[0] || []).map((v) => v === null ? "–" : short(v)).join(", ")} ${one.unit}.`) : [];
    note.textContent = [take.note, ...told, ...film.notes].join(" ");
    image.hidden = !images;
    [...state.curves, ...state.maps].forEach((one) => one.canvas.remove());
    state.maps = maps.map((one) => {
      const made = canvas("map", `${one.name} over the pupil`);
      made.removeAttribute("id");
      side.append(made);
      return { canvas: made, map: one };
    });
    state.curves = series.map((series) => {
      const made = canvas("curve", `${series.name} over time`);
      made.removeAttribute("id");
      side.append(made);
      return { canvas: made, series };
    });
    side.hidden = !images && !series.length && !maps.length;
    scene.hidden = !n;
    color.parentElement.hidden = factor.parentElement.hidden = !n;
    main.querySelector(".views").style.gridTemplateColumns = side.hidden || scene.hidden ? "minmax(0, 1fr)" : "";
    state.range = {};
    if (still) stop();
    document.body.dataset.ready = number;
    draw();
  }

  // Motion ------------------------------------------------------------------------------------------------
  function move(t, by) {
    const { points, body, pivots, axes, terms, count } = state.stage, { poses, figures, shapes, weights, dofs } = state.take;
    const p = points.data, out = state.moved, value = state.value;
    if (!poses && !figures && !shapes) { out.set(p); value.fill(0); return; }
    const pose = [0, 0, 0, 0, 0, 0], bodies = pivots.shape[0], d = dofs ? dofs.length : 0;
    const modes = shapes ? shapes.shape[0] : 0, bent = figures ? terms.shape[1] : 0;
    for (let v = 0; v < count; v++) {
      const b = body.data[v], a = 9 * b, q = axes.data;
      let x = 0, y = 0, z = 0;
      if (poses) {
        pose.fill(0);
        for (let k = 0; k < d; k++) pose[dofs[k]] = poses.data[(t * bodies + b) * d + k] * poses.scale[k];
        const rx = p[3 * v] - pivots.data[3 * b], ry = p[3 * v + 1] - pivots.data[3 * b + 1], rz = p[3 * v + 2] - pivots.data[3 * b + 2];
        const lx = q[a] * rx + q[a + 3] * ry + q[a + 6] * rz, ly = q[a + 1] * rx + q[a + 4] * ry + q[a + 7] * rz,
          lz = q[a + 2] * rx + q[a + 5] * ry + q[a + 8] * rz;
        const ux = pose[0] + pose[4] * lz - pose[5] * ly, uy = pose[1] + pose[5] * lx - pose[3] * lz, uz = pose[2] + pose[3] * ly - pose[4] * lx;
        x = q[a] * ux + q[a + 1] * uy + q[a + 2] * uz;
        y = q[a + 3] * ux + q[a + 4] * uy + q[a + 5] * uz;
        z = q[a + 6] * ux + q[a + 7] * uy + q[a + 8] * uz;
      }
      let height = 0;
      for (let j = 0; j < bent; j++) {
        height += figures.data[(t * bodies + b) * bent + j] * figures.scale[j] * terms.data[v * bent + j] * terms.scale[j];
      }
      x += height * q[a + 2]; y += height * q[a + 5]; z += height * q[a + 8];
      for (let m = 0; m < modes; m++) {
        const w = weights.data[t * modes + m], k = 3 * (m * count + v);
        x += w * shapes.data[k] * shapes.scale[0]; y += w * shapes.data[k + 1] * shapes.scale[1]; z += w * shapes.data[k + 2] * shapes.scale[2];
      }
      out[3 * v] = p[3 * v] + by * x; out[3 * v + 1] = p[3 * v + 1] + by * y; out[3 * v + 2] = p[3 * v + 2] + by * z;
      value[v] = x * q[a + 2] + y * q[a + 5] + z * q[a + 8];
    }
  }

  function wavefront(t) {
    const { points, body, pivots, count } = state.stage, { planes } = state.take, bodies = pivots.shape[0];
    for (let v = 0; v < count; v++) {
      const b = body.data[v], k = 3 * (t * bodies + b);
      state.value[v] = planes.data[k] * planes.scale[0]
        + planes.data[k + 1] * planes.scale[1] * (points.data[3 * v] - pivots.data[3 * b])
        + planes.data[k + 2] * planes.scale[2] * (points.data[3 * v + 1] - pivots.data[3 * b + 1]);
    }
  }

  // One range for all instants of a case, so that colors keep their meaning.
  function range(kind) {
    if (state.range[kind] === undefined) {
      let largest = 0;
      const steps = state.take.time.length, every = Math.max(1, Math.floor(steps / 12));
      for (let t = 0; t < steps; t += every) {
        if (kind === "wavefront") wavefront(t); else move(t, 0);
        for (const v of state.value) largest = Math.max(largest, Math.abs(v));
      }
      state.range[kind] = largest || 1;
    }
    return state.range[kind];
  }

  // Drawing -----------------------------------------------------------------------------------------------
  const STOPS = [[5, 48, 97], [67, 147, 195], [247, 247, 247], [214, 96, 77], [103, 0, 31]];
  const GLOW = [[0, 0, 4], [87, 16, 110], [188, 55, 84], [249, 142, 9], [252, 255, 164]];
  const mixed = (stops, share) => {
    const at = Math.min(0.9999, Math.max(0, share)) * (stops.length - 1), k = Math.floor(at), f = at - k;
    return stops[k].map((c, i) => Math.round(c + f * (stops[k + 1][i] - c)));
  };
  const table = (stops) => Array.from({ length: 256 }, (_, k) => `rgb(${mixed(stops, k / 255).join(",")})`);
  const BLUE_RED = Array.from({ length: 256 }, (_, k) => mixed(STOPS, k / 255)), DIVERGING = table(STOPS);
  const shade = (v) => DIVERGING[Math.max(0, Math.min(255, Math.round(127.5 * (1 + v))))];
  const ink = () => getComputedStyle(document.body).color;

  function context(target) {
    const ratio = Math.min(2, window.devicePixelRatio || 1), width = target.clientWidth, height = target.clientHeight;
    if (target.width !== Math.round(width * ratio) || target.height !== Math.round(height * ratio)) {
      target.width = Math.round(width * ratio); target.height = Math.round(height * ratio);
    }
    const made = target.getContext("2d");
    made.setTransform(ratio, 0, 0, ratio, 0, 0);
    made.clearRect(0, 0, width, height);
    return [made, width, height];
  }

  function frame(points, count) {
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (let v = 0; v < 3 * count; v++) { low[v % 3] = Math.min(low[v % 3], points[v]); high[v % 3] = Math.max(high[v % 3], points[v]); }
    for (const [, line] of state.stage.lines) for (const point of line) for (let k = 0; k < 3; k++) { low[k] = Math.min(low[k], point[k]); high[k] = Math.max(high[k], point[k]); }
    state.middle = low.map((l, k) => (l + high[k]) / 2);
    state.extent = low.map((l, k) => high[k] - l);
  }

  // Whichever way it is turned, what lies within the middle of the stage stays in sight.
  function fitted(width, height) {
    const [x, y, z] = state.extent, wide = Math.hypot(x, y), [ux, uy, uz] = state.stage.up, high = Math.abs(uz) > 0.9 ? z : Math.max(x, y);
    const tall = high * Math.cos(state.pitch0) + (Math.abs(uz) > 0.9 ? wide : Math.hypot(z, Math.min(x, y))) * Math.sin(state.pitch0);
    return 0.9 * Math.min(width / (Math.abs(uz) > 0.9 ? wide : Math.hypot(z, Math.min(x, y)) * 1.05), height / tall);
  }

  function camera(width, height) {
    const [ux, uy, uz] = state.stage.up, flat = Math.abs(uz) > 0.9;
    const side0 = flat ? [1, 0, 0] : [-uy, ux, 0];
    const up = [ux, uy, uz];
    const ahead = flat ? [0, 1, 0] : [0, 0, 1];
    const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    const [cy, sy, cp, sp] = [Math.cos(state.yaw), Math.sin(state.yaw), Math.cos(state.pitch), Math.sin(state.pitch)];
    const towards = up.map((u, k) => cp * (cy * side0[k] - sy * ahead[k]) + sp * u);
    const right0 = cross(up, towards), length = Math.hypot(...right0) || 1, right = right0.map((v) => v / length);
    return { right, above: cross(towards, right), towards, zoom: state.zoom * fitted(width, height), x: width / 2, y: height / 2 };
  }

  function project(eye, points, out, count) {
    const [mx, my, mz] = state.middle, { right: r, above: a, towards: w, zoom } = eye;
    for (let v = 0; v < count; v++) {
      const x = points[3 * v] - mx, y = points[3 * v + 1] - my, z = points[3 * v + 2] - mz;
      out[3 * v] = eye.x + zoom * (r[0] * x + r[1] * y + r[2] * z);
      out[3 * v + 1] = eye.y - zoom * (a[0] * x + a[1] * y + a[2] * z);
      out[3 * v + 2] = w[0] * x + w[1] * y + w[2] * z;
    }
  }

  function drawScene() {
    const [pen, width, height] = context(scene), { stage } = state, t = instant();
    const kind = color.value, most = kind === "body" ? 1 : range(kind);
    move(t, exaggeration());
    if (kind === "wavefront") wavefront(t);
    const eye = camera(width, height), { seen, value } = state;
    project(eye, state.moved, seen, stage.count);
    const f = stage.faces, n = f.shape[1], total = f.shape[0];
    const depth = new Float32Array(total), order = new Uint32Array(total);
    for (let k = 0; k < total; k++) {
      order[k] = k;
      for (let c = 0; c < n; c++) depth[k] += seen[3 * f.data[k * n + c] + 2];
    }
    order.sort((a, b) => depth[a] - depth[b]);
    pen.lineWidth = total > 2000 ? 0.2 : 0.5;
    pen.strokeStyle = "#5b6670";
    for (const k of order) {
      const c = k * n, fixed = stage.palette[stage.colors.data[k]];
      pen.beginPath();
      let mean = 0, least = Infinity, top = -Infinity;
      for (let i = 0; i < n; i++) {
        const v = f.data[c + i];
        pen.lineTo(seen[3 * v], seen[3 * v + 1]);
        mean += value[v] / n; least = Math.min(least, value[v]); top = Math.max(top, value[v]);
      }
      pen.closePath();
      const dead = !state.take.shapes && least === 0 && top === 0;
      pen.fillStyle = kind === "body" || dead ? fixed : (top - least) / most > 0.04 && n > 4 ? gradient(pen, f, c, most) : shade(mean / most);
      pen.fill();
      pen.stroke();
    }
    pen.lineWidth = 1;
    for (const [tint, points] of stage.lines) {
      const flat = Float32Array.from(points.flat()), at = new Float32Array(flat.length);
      project(eye, flat, at, points.length);
      pen.strokeStyle = tint;
      pen.globalAlpha = 0.55;
      pen.beginPath();
      for (let k = 0; k < points.length; k++) pen.lineTo(at[3 * k], at[3 * k + 1]);
      pen.stroke();
    }
    pen.globalAlpha = 1;
    pen.fillStyle = ink();
    pen.font = "13px sans-serif";
    pen.textAlign = "center";
    const at = new Float32Array(3);
    for (const [name, point] of stage.labels) {
      project(eye, Float32Array.from(point), at, 1);
      pen.fillText(name, at[0], at[1] - 6);
    }
    if (kind !== "body") legend(pen, width, height, kind, most);
  }

  // The value is linear over a face, so it is linear on the screen: a gradient between its lines.
  function gradient(pen, f, c, most) {
    const [i, j, k] = [f.data[c], f.data[c + 2], f.data[c + 4]], { seen, value } = state;
    const x1 = seen[3 * j] - seen[3 * i], y1 = seen[3 * j + 1] - seen[3 * i + 1], x2 = seen[3 * k] - seen[3 * i], y2 = seen[3 * k + 1] - seen[3 * i + 1];
    const area = x1 * y2 - x2 * y1, d1 = value[j] - value[i], d2 = value[k] - value[i];
    const gx = (d1 * y2 - d2 * y1) / area, gy = (d2 * x1 - d1 * x2) / area, square = gx * gx + gy * gy;
    if (!(square > 1e-30) || !isFinite(square)) return shade(value[i] / most);
    const low = Math.min(value[i], value[j], value[k]) - 0.2 * Math.abs(d1), high = Math.max(value[i], value[j], value[k]) + 0.2 * Math.abs(d1);
    const at = (v) => [seen[3 * i] + (v - value[i]) * gx / square, seen[3 * i + 1] + (v - value[i]) * gy / square];
    const made = pen.createLinearGradient(...at(low), ...at(high));
    for (let s = 0; s <= 4; s++) made.addColorStop(s / 4, shade((low + (high - low) * s / 4) / most));
    return made;
  }

  const short = (v) => Math.abs(v) >= 1e4 || (v && Math.abs(v) < 1e-2) ? v.toExponential(1) : Number(v.toPrecision(3)).toString();
  function legend(pen, width, height, kind, most) {
    const wide = Math.min(180, width - 90), left = width - wide - 16, low = height - 26;
    pen.globalAlpha = 0.8; pen.fillStyle = getComputedStyle(document.body).backgroundColor; pen.fillRect(left - 30, low - 18, wide + 44, 44); pen.globalAlpha = 1;
    for (let k = 0; k < wide; k++) { pen.fillStyle = shade(2 * k / wide - 1); pen.fillRect(left + k, low, 1.5, 10); }
    pen.fillStyle = ink();
    const [unit, by] = kind === "wavefront" ? ["nm", 1] : most < 1e-6 ? ["nm", 1e9] : most < 1e-3 ? ["µm", 1e6] : ["m", 1];
    pen.textAlign = "left"; pen.fillText(`-${short(most * by)}`, left, low - 4);
    pen.textAlign = "right"; pen.fillText(`${short(most * by)} ${unit}`, left + wide, low - 4);
    pen.textAlign = "center"; pen.fillText(kind === "wavefront" ? "wavefront" : "along the normal", left + wide / 2, low + 22);
  }

  // Paint cells (lowest row first) on a canvas, smooth or not.
  function paint(pen, columns, rows, width, height, colorOf) {
    const pixels = new ImageData(columns, rows);
    for (let r = 0; r < rows; r++) for (let c = 0; c < columns; c++) {
      const tint = colorOf((rows - 1 - r) * columns + c), k = 4 * (r * columns + c);
      if (tint) { pixels.data[k] = tint[0]; pixels.data[k + 1] = tint[1]; pixels.data[k + 2] = tint[2]; pixels.data[k + 3] = 255; }
    }
    state.spare = state.spare || document.createElement("canvas");
    state.spare.width = columns; state.spare.height = rows;
    state.spare.getContext("2d").putImageData(pixels, 0, 0);
    pen.imageSmoothingEnabled = false;
    pen.drawImage(state.spare, 0, 0, columns, rows, 0, 0, width, height);
  }

  function drawMap({ canvas: target, map }) {
    const [pen, width, height] = context(target), { cells, parts, shares, reach } = map, n = cells.shape[0];
    const [r, count] = parts.shape, t = instant(), values = new Float32Array(count), by = parts.scale[0] / (reach || 1);
    for (let m = 0; m < r; m++) {
      const w = shares.data[t * r + m] * by;
      if (w) for (let k = 0; k < count; k++) values[k] += w * parts.data[m * count + k];
    }
    const wide = Math.min(width, height - 40);
    pen.save();
    pen.translate((width - wide) / 2, 20);
    paint(pen, n, n, wide, wide, (k) => cells.data[k] < 0 ? null : BLUE_RED[Math.max(0, Math.min(255, Math.round(127.5 * (1 + values[cells.data[k]]))))]);
    pen.restore();
    pen.fillStyle = ink(); pen.font = "12px sans-serif"; pen.textAlign = "left";
    pen.fillText(map.name, 6, 14);
    const left = 70, long = width - 140;
    for (let k = 0; k < long; k++) { pen.fillStyle = shade(2 * k / long - 1); pen.fillRect(left + k, height - 15, 1.5, 8); }
    pen.fillStyle = ink();
    const [unit, less] = map.unit === "nm" && reach >= 1e4 ? ["µm", 1e-3] : [map.unit, 1];
    pen.textAlign = "right"; pen.fillText(`-${short(reach * less)}`, left - 5, height - 7);
    pen.textAlign = "left"; pen.fillText(`${short(reach * less)} ${unit}`, left + long + 5, height - 7);
  }

  function drawImage() {
    const { images, every, pixel, track } = state.take;
    if (!images) return;
    const [pen, width, height] = context(image), [count, rows, columns] = images.shape;
    const chosen = Math.min(count - 1, Math.floor(instant() / every)), start = chosen * rows * columns;
    if (!state.glow) state.glow = Array.from({ length: 256 }, (_, k) => mixed(GLOW, k / 255));
    paint(pen, columns, rows, width, height, (k) => state.glow[images.data[start + k]]);
    if (track) {
      const x = (v) => width * (0.5 + (v / pixel + 0.5) / columns), y = (v) => height * (0.5 - (v / pixel + 0.5) / rows), now = track[instant()];
      pen.strokeStyle = pen.fillStyle = "#5ad1ff"; pen.lineWidth = 1; pen.beginPath();
      for (let k = 0; k <= instant(); k++) pen.lineTo(x(track[k][0]), y(track[k][1]));
      pen.stroke();
      pen.beginPath(); pen.arc(x(now[0]), y(now[1]), 3, 0, 7); pen.fill();
    }
    pen.fillStyle = "#fff"; pen.font = "12px sans-serif"; pen.textAlign = "left";
    pen.fillText(`image, ${film.decades} decades, ${short(columns * pixel)} λ/D wide`, 6, 16);
  }

  function drawCurve({ canvas: target, series }) {
    const [pen, width, height] = context(target), { values, name, unit } = series, ends = state.take.time;
    const flat = values.flat().filter(Number.isFinite), least = Math.min(...flat), most = Math.max(...flat);
    // What is constant but for rounding is drawn as a line.
    const flatly = most - least < 1e-3 * Math.max(Math.abs(most), Math.abs(least)), low = flatly ? least - 0.1 * Math.abs(least) : least,
      high = flatly ? most + 0.1 * Math.abs(most) : most;
    const span = high - low || Math.abs(high) || 1, left = 54, bottom = height - 20, top = 22;
    const x = (k) => left + (width - left - 8) * k / Math.max(1, ends.length - 1), y = (v) => bottom - (bottom - top) * (v - low) / span;
    pen.fillStyle = ink(); pen.font = "12px sans-serif"; pen.textAlign = "left";
    pen.fillText(`${name} (${unit})`, 6, 14);
    pen.textAlign = "right";
    pen.fillText(short(high), left - 6, top + 6); pen.fillText(short(low), left - 6, bottom);
    pen.fillText(`${short(ends[ends.length - 1])} s`, width - 8, height - 5);
    ["#0072b2", "#d55e00"].forEach((tint, axis) => {
      if (values[0].length <= axis) return;
      pen.strokeStyle = tint; pen.lineWidth = 1.2; pen.beginPath();
      values.forEach((row, k) => { if (row[axis] !== null) pen.lineTo(x(k), y(row[axis])); });
      pen.stroke();
    });
    pen.strokeStyle = ink(); pen.lineWidth = 1; pen.beginPath();
    pen.moveTo(x(instant()), top); pen.lineTo(x(instant()), bottom); pen.stroke();
  }

  function drawAll() {
    if (!state.take) return;
    if (state.playing) {
      const steps = state.take.time.length, lasting = Math.max(3000, 40 * steps);
      time.value = Math.floor(state.from + (performance.now() - state.began) / lasting * steps) % steps;
    }
    const by = exaggeration();
    clock.textContent = `${(1e3 * state.take.time[instant()]).toFixed(2)} ms`;
    scale.textContent = by ? `× ${short(by)}` : "none";
    if (!scene.hidden) drawScene();
    drawImage();
    state.maps.forEach(drawMap);
    state.curves.forEach(drawCurve);
    document.body.dataset.frames = Number(document.body.dataset.frames || 0) + 1;
    if (state.playing) draw();
  }

  // Input -------------------------------------------------------------------------------------------------
  function stop() { state.playing = false; play.textContent = "Play"; }
  play.addEventListener("click", () => {
    if (state.playing) { stop(); say(`Stopped at ${clock.textContent}`); } else {
      state.playing = true; state.began = performance.now(); state.from = instant(); play.textContent = "Pause"; say("");
    }
    draw();
  });
  time.addEventListener("input", () => { stop(); draw(); });
  factor.addEventListener("input", draw);
  color.addEventListener("change", draw);
  const failed = (error) => say(`This page cannot be shown: ${error.message}`);
  cases.addEventListener("change", () => choose(Number(cases.value)).catch(failed));
  let held = null;
  scene.addEventListener("pointerdown", (event) => { held = [event.clientX, event.clientY]; scene.setPointerCapture(event.pointerId); });
  scene.addEventListener("pointermove", (event) => {
    if (!held) return;
    turn((event.clientX - held[0]) / 150, (event.clientY - held[1]) / 150);
    held = [event.clientX, event.clientY];
  });
  scene.addEventListener("pointerup", () => { held = null; });
  scene.addEventListener("wheel", (event) => { event.preventDefault(); grow(Math.exp(-event.deltaY / 600)); }, { passive: false });
  scene.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[event.key];
    if (step) turn(...step);
    else if (event.key === "+") grow(1.15);
    else if (event.key === "-") grow(1 / 1.15);
    else return;
    event.preventDefault();
  });
  function turn(yaw, pitch) { state.yaw -= yaw; state.pitch = Math.max(-1.5, Math.min(1.5, state.pitch + pitch)); draw(); }
  function grow(by) { state.zoom = Math.max(0.2, Math.min(20, state.zoom * by)); draw(); }
  window.addEventListener("resize", draw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);

  window.viewer = { state, move, choose };  // for tests, and for the curious
  try {
    await choose(0);
    if (film.takes[0].time.length > 1 && !matchMedia("(prefers-reduced-motion: reduce)").matches && !location.hash.includes("paused")) play.click();
  } catch (error) { failed(error); }
})();
