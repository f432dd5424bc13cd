"""How report.html looks: one style sheet, light and dark, no script and nothing from elsewhere."""

CSS = """
:root { color-scheme: light dark;
  --page: #f7f6f3; --card: #ffffff; --ink: #1d1d1b; --quiet: #6d6b66; --line: #e2dfd8; --accent: #b4541a;
  --lit: #e08a1e; --unlit: #3f6f9c; --partial: #b9a3cf; --out: #cfcbc2; }
@media (prefers-color-scheme: dark) { :root {
  --page: #161615; --card: #1f1f1d; --ink: #ebe9e4; --quiet: #98958d; --line: #33322f; --accent: #f0a35c;
  --lit: #f2a33a; --unlit: #6fa3d3; --partial: #9d83b8; --out: #4a4843; } }
* { box-sizing: border-box }
body { margin: 0; background: var(--page); color: var(--ink);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif }
main { max-width: 1120px; margin: 0 auto; padding: 40px 24px 80px }
h1 { font-size: 30px; font-weight: 650; letter-spacing: -.01em; margin: 0 }
h2 { font-size: 18px; font-weight: 650; margin: 44px 0 12px }
p { margin: 6px 0 12px; max-width: 75ch }
.quiet, figcaption, td.quiet, th { color: var(--quiet) }
.facts { display: flex; flex-wrap: wrap; gap: 8px 28px; margin: 14px 0 0; padding: 0; list-style: none }
.facts b { font-weight: 650; font-variant-numeric: tabular-nums }
.grid { display: grid; gap: 14px; grid-template-columns: repeat(auto-fill, minmax(230px, 1fr)) }
.pairs { grid-template-columns: repeat(auto-fill, minmax(340px, 1fr)) }
.wide { grid-template-columns: 1fr }
figure { margin: 0; background: var(--card); border: 1px solid var(--line); border-radius: 10px;
  overflow: hidden }
figure img { display: block; width: 100%; height: auto; background: #000 }
figcaption { padding: 7px 11px 8px; font-size: 13px }
table { border-collapse: collapse; width: 100%; background: var(--card); border: 1px solid var(--line);
  border-radius: 10px; overflow: hidden; font-size: 14px }
th, td { text-align: left; vertical-align: top; padding: 7px 12px; border-top: 1px solid var(--line) }
tr:first-child th, tr:first-child td { border-top: 0 }
th { font-weight: 550; font-size: 13px }
td.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap }
.tag { display: inline-block; padding: 0 8px; border-radius: 9px; font-size: 12.5px;
  border: 1px solid var(--line) }
.tag.run { color: var(--accent); border-color: var(--accent) }
.warnings { border-left: 3px solid var(--accent); padding: 2px 0 2px 14px; list-style: none; margin: 8px 0 }
svg.strip { width: 100%; height: 54px; background: var(--card); border: 1px solid var(--line);
  border-radius: 10px }
.lit { fill: var(--lit); color: var(--lit) } .unlit { fill: var(--unlit); color: var(--unlit) }
.partial { fill: var(--partial); color: var(--partial) } .out { fill: var(--out); color: var(--out) }
.legend span { margin-right: 18px }
.legend i { display: inline-block; width: 10px; height: 10px; border-radius: 2px; margin-right: 6px;
  background: currentColor }
footer { margin-top: 60px; font-size: 13px; color: var(--quiet) }
"""
