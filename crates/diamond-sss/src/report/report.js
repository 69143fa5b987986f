// The light control: pictures under single lights, decoded to linear light, weighted, added, encoded again.
(async () => {
  "use strict";
  const { width, height, lights } = JSON.parse(document.getElementById("olat").textContent);
  const canvas = document.getElementById("picture"), disc = document.getElementById("disc");
  const exposure = document.getElementById("exposure"), stops = document.getElementById("stops");
  const colour = document.getElementById("colour"), sliders = document.getElementById("sliders");
  const mixer = document.getElementById("mixer");
  canvas.width = width; canvas.height = height;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  const decode = Float32Array.from({ length: 256 }, (_, i) => {
    const v = i / 255; return v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
  });
  const LEVELS = 4096;
  const encode = Uint8ClampedArray.from({ length: LEVELS + 1 }, (_, i) => {
    const v = i / LEVELS; return Math.round(255 * (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055));
  });
  for (const light of lights) {
    const image = new Image(); image.src = light.picture; await image.decode();
    context.drawImage(image, 0, 0, width, height);
    const bytes = context.getImageData(0, 0, width, height).data;
    light.linear = new Float32Array(width * height * 3);
    for (let i = 0, k = 0; i < bytes.length; i += 4)
      for (let c = 0; c < 3; c++) light.linear[k++] = decode[bytes[i + c]];
  }
  // Azimuthal equidistant map of the sphere: the angle from the camera is the distance from the centre.
  const R = 100, place = ([x, y, z]) => {
    const angle = Math.acos(Math.max(-1, Math.min(1, z))), flat = Math.hypot(x, y) || 1;
    return [x / flat * angle / Math.PI * R, -y / flat * angle / Math.PI * R];
  };
  const direction = (px, py) => {
    const r = Math.min(Math.hypot(px, py), R), angle = r / R * Math.PI, flat = Math.hypot(px, py) || 1;
    return [px / flat * Math.sin(angle), -py / flat * Math.sin(angle), Math.cos(angle)];
  };
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  // As sharp as the spacing of the lights allows: the mean gap to the nearest neighbour.
  const gaps = lights.map((a) => Math.min(...lights.filter((b) => b !== a).map((b) => 1 - dot(a.direction, b.direction)), 2));
  const gap = gaps.reduce((s, g) => s + g, 0) / Math.max(1, gaps.length);
  const sharpness = 2.5 / Math.max(gap, 1e-3);
  const NS = "http://www.w3.org/2000/svg";
  const element = (name, attributes, text) => {
    const e = document.createElementNS(NS, name);
    for (const [k, v] of Object.entries(attributes)) e.setAttribute(k, v);
    if (text) e.textContent = text;
    return disc.appendChild(e);
  };
  element("circle", { r: R, class: "ring" });
  element("circle", { r: R / 2, class: "half" });
  element("text", { x: 0, y: R / 2 - 5 }, "90°");
  element("text", { x: 0, y: R - 6 }, "behind");
  const dots = lights.map((l) => { const [cx, cy] = place(l.direction); return element("circle", { cx, cy, r: 5, class: "light" }); });
  const handle = element("circle", { r: 9, class: "handle" });
  let at = lights.length ? place(lights[0].direction) : [0, 0];
  const mix = lights.map((_, i) => (i === 0 ? 1 : 0)), on = lights.map(() => true);
  lights.forEach((_, i) => {
    const label = document.createElement("label"), box = document.createElement("input"), range = document.createElement("input");
    box.type = "checkbox"; box.checked = true; box.title = "on or off";
    range.type = "range"; range.min = 0; range.max = 2; range.step = 0.01; range.value = mix[i];
    box.onchange = () => { on[i] = box.checked; choose("mix"); };
    range.oninput = () => { mix[i] = +range.value; choose("mix"); };
    label.append(box, `Light ${i + 1}`, range); sliders.append(label);
  });
  const mode = () => document.querySelector("input[name=mode]:checked").value;
  const choose = (value) => { document.querySelector(`input[name=mode][value=${value}]`).checked = true; draw(); };
  const weights = () => {
    if (mode() === "mix") return mix.map((w, i) => (on[i] ? w : 0));
    const d = direction(...at), w = lights.map((l) => Math.exp(sharpness * (dot(d, l.direction) - 1)) + 1e-12);
    const sum = w.reduce((s, v) => s + v, 0);
    return w.map((v) => v / sum);
  };
  let queued = false;
  const draw = () => { if (!queued) { queued = true; requestAnimationFrame(paint); } };
  const paint = () => {
    queued = false;
    const w = weights(), n = width * height * 3, sum = new Float32Array(n), gain = 2 ** +exposure.value;
    lights.forEach((light, i) => { if (w[i] > 1e-4) { const s = light.linear, k = w[i]; for (let j = 0; j < n; j++) sum[j] += k * s[j]; } });
    const tint = [1, 3, 5].map((i) => decode[parseInt(colour.value.slice(i, i + 2), 16)] * gain);
    const out = context.createImageData(width, height);
    for (let i = 0, j = 0; j < n; i += 4, j += 3) {
      for (let c = 0; c < 3; c++) out.data[i + c] = encode[Math.min(LEVELS, Math.round(sum[j + c] * tint[c] * LEVELS))];
      out.data[i + 3] = 255;
    }
    context.putImageData(out, 0, 0);
    dots.forEach((e, i) => e.setAttribute("fill", `rgba(230,140,60,${Math.min(1, 0.08 + w[i])})`));
    handle.setAttribute("cx", at[0]); handle.setAttribute("cy", at[1]);
    handle.style.display = mode() === "drag" ? "" : "none";
    stops.textContent = `${(+exposure.value).toFixed(2)} EV`;
  };
  const move = (x, y) => { const r = Math.hypot(x, y), k = r > R ? R / r : 1; at = [x * k, y * k]; choose("drag"); };
  const pointer = (e) => {
    const box = disc.getBoundingClientRect();
    move((e.clientX - box.left) / box.width * 220 - 110, (e.clientY - box.top) / box.height * 220 - 110);
  };
  disc.onpointerdown = (e) => { disc.setPointerCapture(e.pointerId); pointer(e); };
  disc.onpointermove = (e) => { if (e.buttons) pointer(e); };
  disc.onkeydown = (e) => {
    const step = { ArrowLeft: [-4, 0], ArrowRight: [4, 0], ArrowUp: [0, -4], ArrowDown: [0, 4] }[e.key];
    if (step) { e.preventDefault(); move(at[0] + step[0], at[1] + step[1]); }
  };
  exposure.oninput = colour.oninput = draw;
  document.querySelectorAll("input[name=mode]").forEach((r) => { r.onchange = () => { mixer.open = mode() === "mix"; draw(); }; });
  document.body.dataset.ready = "yes";
  draw();
})();
