"""The preview's page: one file without anything from elsewhere, that polls state and picture."""

from __future__ import annotations

from capture.live.state import BIN_DEG, BINS


def page(nonce: str) -> str:
    """The page's HTML; its style and script carry the nonce that the server's policy allows."""
    values = {"NONCE": nonce, "STYLE": _STYLE, "BODY": _BODY, "SCRIPT": _SCRIPT}
    text = _FRAME
    for name, value in values.items():
        text = text.replace(f"%{name}%", value)
    return text.replace("%BINS%", str(BINS)).replace("%BIN_DEG%", str(BIN_DEG))


_FRAME = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>Recording</title><link rel="icon" href="data:,">
<style nonce="%NONCE%">%STYLE%</style></head>
<body>%BODY%<script nonce="%NONCE%">%SCRIPT%</script></body></html>
"""

_STYLE = """
:root { color-scheme: dark; --ground: #17181a; --card: #202225; --line: #33363b; --text: #e7e6e3;
  --quiet: #9a9ca1; --cyan: #6fb7c8; --amber: #e3b15c; --green: #86b573; --red: #dc7264; }
* { box-sizing: border-box; margin: 0; }
body { background: var(--ground); color: var(--text); font: 15px/1.4 system-ui, sans-serif; height: 100vh;
  min-height: 690px; display: grid; gap: 16px; padding: 18px 22px;
  grid-template: auto auto minmax(0, 1fr) auto / minmax(0, 1fr) 400px; }
header { grid-column: 1 / 3; display: flex; align-items: baseline; gap: 18px; }
h1 { font-size: 17px; font-weight: 600; } .quiet { color: var(--quiet); }
#left { margin-left: auto; font-size: 26px; font-weight: 600; font-variant-numeric: tabular-nums; }
#done { grid-column: 1 / 3; height: 3px; background: var(--line); border-radius: 2px; margin-top: -8px; }
#done i { display: block; height: 100%; width: 0; background: var(--cyan); border-radius: 2px; }
#view { position: relative; background: #0e0f10; border-radius: 12px; overflow: hidden; display: flex; }
#view img { width: 100%; height: 100%; object-fit: contain; }
#view p { position: absolute; inset: 0; margin: auto; height: 1.4em; text-align: center; }
#side { display: flex; flex-direction: column; gap: 14px; min-height: 0; }
.card { background: var(--card); border-radius: 12px; padding: 14px 16px; }
.card h2 { font-size: 12px; font-weight: 600; color: var(--quiet); margin-bottom: 8px; }
.key { float: right; font-weight: 400; } .was { background: var(--cyan); } .lit { background: var(--amber); }
.key i { display: inline-block; width: 9px; height: 9px; border-radius: 2px; margin: 0 5px 0 12px; }
#around { font-size: 30px; font-weight: 600; fill: var(--text); text-anchor: middle; }
.small { font-size: 12.5px; fill: var(--quiet); text-anchor: middle; }
.bin { fill: none; stroke-width: 17; stroke: var(--line); } .seen { stroke: var(--cyan); }
.flash { stroke: var(--amber); }
dl { display: grid; grid-template-columns: 66px 1fr 74px; gap: 9px 12px; align-items: center; }
dt { color: var(--quiet); } dd { font-variant-numeric: tabular-nums; text-align: right; white-space: nowrap; }
.bar { height: 7px; background: var(--line); border-radius: 4px; overflow: hidden; }
.bar i { display: block; height: 100%; width: 0; border-radius: 4px; background: var(--green); }
.good { background: var(--green) !important; } .warn { background: var(--amber) !important; }
.bad { background: var(--red) !important; }
footer { grid-column: 1 / 3; display: grid; grid-template-columns: minmax(0, 1fr) 400px; gap: 16px;
  align-items: center; }
#advice { font-size: 22px; font-weight: 600; min-height: 1.4em; }
#strip { width: 100%; height: 34px; display: block; }
.numbers { display: flex; justify-content: space-between; margin-top: 12px;
  font-variant-numeric: tabular-nums; }
.numbers b { display: block; font-size: 19px; font-weight: 600; }
@media (max-width: 820px) { body { grid-template-columns: 1fr; height: auto; }
  header, #done, footer { grid-column: 1; } footer { grid-template-columns: 1fr; } #view { height: 60vh; } }
"""

_BODY = """
<header><h1>Recording</h1><span class="quiet" id="elapsed"></span><span id="left"></span></header>
<div id="done"><i></i></div>
<main id="view"><p class="quiet" id="none">waiting for the first picture</p>
 <img id="picture" alt="" hidden></main>
<section id="side">
 <div class="card"><h2>around the head
   <span class="key"><i class="was"></i>seen<i class="lit"></i>with flash</span></h2>
  <svg id="gauge" viewBox="0 0 368 196" role="img" aria-label="view directions so far">
   <g id="bins"></g>
   <g fill="none" stroke="#9a9ca1" stroke-width="2.2" stroke-linecap="round" stroke-linejoin="round">
    <ellipse cx="184" cy="26" rx="19" ry="21"/><path d="M180 47 l4 7 4 -7"/>
    <path d="M165 20 q-6 5 0 12M203 20 q6 5 0 12"/>
   </g>
   <path id="camera" d="M0 -9 L8 7 L-8 7 Z" fill="#fff" visibility="hidden"/>
   <text id="around" x="184" y="104"></text><text id="height" class="small" x="184" y="126"></text>
  </svg></div>
 <div class="card"><dl>
  <dt>room</dt><div class="bar"><i id="room"></i></div><dd id="room-n"></dd>
  <dt>flash</dt><div class="bar"><i id="flash"></i></div><dd id="flash-n"></dd>
  <dt>clipped</dt><div class="bar"><i id="clipped"></i></div><dd id="clipped-n"></dd>
  <dt>dark</dt><div class="bar"><i id="dark"></i></div><dd id="dark-n"></dd>
  <dt>sharp</dt><div class="bar"><i id="sharp"></i></div><dd id="sharp-n"></dd>
  <dt>head</dt><div class="bar"><i id="head"></i></div><dd id="head-n"></dd>
 </dl>
 <div class="numbers"><span><b id="pulses"></b><span class="quiet">flashes</span></span>
  <span><b id="frames"></b><span class="quiet">frames</span></span>
  <span><b id="drops"></b><span class="quiet">lost</span></span>
  <span><b id="queue"></b><span class="quiet">waiting</span></span></div></div>
</section>
<footer><div id="advice" role="status" aria-live="polite"></div>
 <svg id="strip" preserveAspectRatio="none" role="img" aria-label="flash of the last frames"></svg></footer>
"""

_SCRIPT = """
const at = id => document.getElementById(id), NS = "http://www.w3.org/2000/svg";
const N = %BINS%, CX = 184, CY = 26, R = 148;
const spot = (part, r) => {
  const a = Math.PI * (1 - part); return [CX + r * Math.cos(a), CY + r * Math.sin(a)]; };
const arcs = [];
for (let k = 0; k < N; k++) {
  const [x0, y0] = spot((k + .07) / N, R), [x1, y1] = spot((k + .93) / N, R);
  const arc = document.createElementNS(NS, "path");
  arc.setAttribute("d", `M${x0} ${y0} A${R} ${R} 0 0 0 ${x1} ${y1}`);
  arc.setAttribute("class", "bin"); at("bins").append(arc); arcs.push(arc);
}
const percent = (v, digits = 0) => `${(100 * v).toFixed(digits)} %`;
function bar(id, share, words, kind = "good") {
  at(id).style.width = `${100 * Math.min(1, Math.max(0, share))}%`; at(id).className = kind;
  at(id + "-n").textContent = words;
}
function strip(labels) {
  const heights = {lit: 26, partial: 13, unlit: 3, unknown: 1.5}, tones = {lit: "#e3b15c", partial: "#a98446",
    unlit: "#5a5d63", unknown: "#3c3f44"}, n = Math.max(labels.length, 90);
  at("strip").setAttribute("viewBox", `0 0 ${n} 30`);
  at("strip").replaceChildren(...labels.map((label, k) => {
    const cell = document.createElementNS(NS, "rect"), h = heights[label] || 1.5;
    cell.setAttribute("x", n - labels.length + k); cell.setAttribute("width", .82);
    cell.setAttribute("y", 29 - h); cell.setAttribute("height", h);
    cell.setAttribute("fill", tones[label] || "#333");
    return cell; }));
}
function show(s) {
  at("elapsed").textContent = `${s.elapsed_s.toFixed(1)} s`;
  at("left").textContent = s.finished ? "done" : `${Math.ceil(s.left_s)} s left`;
  at("done").firstChild.style.width = `${100 * s.elapsed_s / Math.max(s.elapsed_s + s.left_s, 1e-6)}%`;
  const c = s.coverage, known = c.span_deg !== null;
  arcs.forEach((arc, k) => {
    arc.setAttribute("class", "bin" + (known ? ["", " seen", " flash"][c.bins[k]] : "")); });
  at("around").textContent =
    known ? `${c.at_least ? "\\u2265 " : ""}${c.span_deg.toFixed(0)}\\u00b0` : "cannot tell";
  at("height").textContent =
    known ? `up and down ${c.elevation_span_deg.toFixed(0)}\\u00b0` : "nothing to follow behind the head";
  if (c.place === null) at("camera").setAttribute("visibility", "hidden");
  else { const [x, y] = spot(c.place / N, R - 24), turn = 90 * (1 - 2 * c.place / N);
    at("camera").setAttribute("visibility", "visible");
    at("camera").setAttribute("transform", `translate(${x} ${y}) rotate(${turn})`); }
  bar("room", s.level, percent(s.level));
  bar("flash", s.level_lit ?? 0, s.level_lit === null ? "none yet" : percent(s.level_lit), "warn");
  const clip = s.clipped_subject;
  bar("clipped", clip / .1, percent(clip, 1), clip < .01 ? "good" : clip < .04 ? "warn" : "bad");
  bar("dark", s.dark, percent(s.dark), s.dark < .2 ? "good" : "warn");
  bar("sharp", s.sharpness, percent(s.sharpness), s.sharpness > .55 ? "good" : "warn");
  const m = s.motion;
  bar("head", m ?? 0, m === null ? "cannot tell" : m < .25 ? "still" : m < .6 ? "a little" : "moving",
    m > .6 ? "warn" : "good");
  at("pulses").textContent = s.pulses_seen + (s.pulses_expected === null ? "" : ` of ${s.pulses_expected}`);
  for (const id of ["frames", "drops", "queue"]) at(id).textContent = s[id];
  at("advice").textContent = s.advice; strip(s.labels);
}
let shown = 0;
const wait = ms => new Promise(done => setTimeout(done, ms));
async function run() {
  for (let failed = 0; failed < 20;) {
    try {
      const answer = await fetch("state.json"); if (!answer.ok) throw 0;
      const state = await answer.json(); show(state); failed = 0;
      if (state.picture !== shown) { shown = state.picture; const image = new Image();
        image.onload = () => {
          at("picture").src = image.src; at("picture").hidden = false; at("none").hidden = true; };
        image.src = `picture.jpg?${shown}`; }
    } catch { failed++; }
    await wait(130);
  }
  at("advice").textContent = "The recording is over; this page can be closed."; at("left").textContent = "";
}
run();
"""
