"""The look of report pages, as text that goes into each page: they load nothing, so that a file mailed to a colleague
is complete."""

CSS = """
:root{color-scheme:light dark;--paper:#fbfcfd;--card:#fff;--ink:#1d2733;--faint:#5c6976;--rule:#d6dce2;--soft:#eef2f6;
--accent:#1f6fae;--dry:#b8650f;--wet:#1f6fae;--good:#1c7c53;--goodbg:#e6f5ee;--warn:#8a5a00;--warnbg:#fdf3dc;--bad:#b3303f;--badbg:#fdeaec}
@media(prefers-color-scheme:dark){:root{--paper:#11161c;--card:#171e26;--ink:#e4eaf0;--faint:#9aa7b4;--rule:#34404c;
  --soft:#1e2730;
--accent:#6cb4ec;--dry:#e79a4a;--wet:#6cb4ec;--good:#6fd3a5;--goodbg:#14302a;--warn:#eec06a;--warnbg:#33290f;--bad:#f3919b;--badbg:#3a1a20}}
*{box-sizing:border-box}
html{-webkit-text-size-adjust:100%}
body{margin:0;background:var(--paper);color:var(--ink);
  font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",sans-serif}
main{max-width:62rem;margin:0 auto;padding:2.4rem 1.2rem 4rem}
header p.kicker{margin:0;color:var(--faint);font-size:.82rem;letter-spacing:.08em;text-transform:uppercase}
h1{margin:.1rem 0 .3rem;font-size:clamp(1.6rem,5vw,2.3rem);line-height:1.15;letter-spacing:-.015em}
h2{margin:3rem 0 .3rem;font-size:1.3rem;line-height:1.25;letter-spacing:-.01em;scroll-margin-top:1rem}
p{margin:.5rem 0;max-width:46rem}
p.lead{font-size:1.06rem;color:var(--ink)}
p.subtitle{color:var(--faint);margin-top:0}
a{color:var(--accent)}
code{font:.88em ui-monospace,SFMono-Regular,Menlo,Consolas,monospace;background:var(--soft);padding:.08em .35em;
  border-radius:4px;overflow-wrap:anywhere}
pre{font:.82rem/1.5 ui-monospace,SFMono-Regular,Menlo,Consolas,monospace;background:var(--soft);padding:.8rem 1rem;
  border-radius:8px;overflow:auto;white-space:pre-wrap;overflow-wrap:anywhere}
.verdict{margin:1.2rem 0 1.4rem;padding:.8rem 1.1rem;border-radius:10px;border-left:5px solid;max-width:none;
  font-size:1.08rem}
.verdict b{margin-right:.35rem}
.good{color:var(--good)}.warn{color:var(--warn)}.bad{color:var(--bad)}
.verdict.good{background:var(--goodbg);border-color:var(--good);color:inherit}.verdict.good b{color:var(--good)}
.verdict.warn{background:var(--warnbg);border-color:var(--warn);color:inherit}.verdict.warn b{color:var(--warn)}
.verdict.bad{background:var(--badbg);border-color:var(--bad);color:inherit}.verdict.bad b{color:var(--bad)}
nav{display:flex;flex-wrap:wrap;gap:.3rem 1.1rem;font-size:.9rem;margin:.4rem 0 0}
nav a{text-decoration:none}nav a:hover{text-decoration:underline}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(9.2rem,1fr));gap:.7rem;margin:1.2rem 0}
.tile{background:var(--card);border:1px solid var(--rule);border-radius:10px;padding:.75rem .95rem}
.tile .label{color:var(--faint);font-size:.82rem;line-height:1.3}
.tile .value{font-size:1.5rem;font-weight:620;line-height:1.25;font-variant-numeric:tabular-nums;
  letter-spacing:-.01em;overflow-wrap:anywhere}
.tile .unit{font-size:.95rem;font-weight:400;color:var(--faint);margin-left:.25rem}
.tile .note{color:var(--faint);font-size:.8rem;line-height:1.35;margin-top:.15rem}
figure{margin:1.2rem 0}
figure .plate{background:var(--card);border:1px solid var(--rule);border-radius:10px;padding:.6rem;overflow:hidden}
figure svg{display:block;width:100%;height:auto;max-height:80vh}
figure img{display:block;max-width:100%;height:auto;margin:0 auto;border-radius:4px}
figcaption{color:var(--faint);font-size:.9rem;line-height:1.45;margin:.45rem .2rem 0;max-width:46rem}
figcaption b{color:var(--ink);font-weight:600}
.row{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,17rem),1fr));gap:1rem}
.row figure{margin:.4rem 0}
.scroll{overflow-x:auto;margin:1rem 0}
table{border-collapse:collapse;font-size:.92rem;font-variant-numeric:tabular-nums;min-width:60%}
caption{caption-side:bottom;text-align:left;color:var(--faint);font-size:.88rem;padding:.5rem .2rem 0}
th,td{padding:.38rem .8rem .38rem .3rem;text-align:left;border-bottom:1px solid var(--rule);vertical-align:top}
th{font-weight:600;color:var(--faint);font-size:.84rem;white-space:nowrap}
td.number,th.number{text-align:right;white-space:nowrap;padding-left:1rem}
td:last-child:not(.number){min-width:10rem}
tr.strong td{font-weight:600}
details{border:1px solid var(--rule);border-radius:10px;padding:.2rem 1rem;margin:1rem 0;background:var(--card)}
summary{cursor:pointer;padding:.45rem 0;color:var(--faint)}
details[open] summary{color:var(--ink)}
.two{position:relative;overflow:hidden;border-radius:4px;line-height:0;touch-action:pan-y}
.two img{width:100%;margin:0;border-radius:0}
.two img+img{position:absolute;inset:0;height:100%}
.two.slide img+img{clip-path:inset(0 0 0 var(--cut,50%))}
.two.slide::after{content:"";position:absolute;top:0;bottom:0;left:var(--cut,50%);width:2px;margin-left:-1px;
  background:#fff;box-shadow:0 0 3px #000a}
.two.slide input{position:absolute;inset:0;width:100%;height:100%;margin:0;opacity:0;cursor:ew-resize}
.two.slide:focus-within{outline:3px solid var(--accent);outline-offset:2px}
.two .tag{position:absolute;bottom:.5rem;padding:.15rem .5rem;border-radius:5px;background:#000a;color:#fff;
  font-size:.8rem;line-height:1.3}
.two .tag.a{left:.5rem}.two .tag.b{right:.5rem}
.blink input{accent-color:var(--accent)}
.blink label{font-size:.88rem;color:var(--faint);cursor:pointer}
.blink .two img+img,.blink .two .tag.b{animation:blink 1.2s steps(1) infinite}
.blink .two .tag.a{animation:blink 1.2s steps(1) -.6s infinite}
.blink .two .tag.b{right:auto;left:.5rem}
.blink:has(input:checked) .two *{animation-play-state:paused}
@keyframes blink{0%{opacity:1}50%{opacity:0}}
@media(prefers-reduced-motion:reduce){.blink .two *{animation-duration:4s!important}}
footer{margin-top:3.5rem;padding-top:1rem;border-top:1px solid var(--rule);color:var(--faint);font-size:.84rem}
@media print{body{background:#fff}figure,.tile,tr{break-inside:avoid}.two input{display:none}}
"""

ICON = (
    "data:image/svg+xml,%3Csvg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 32 32'%3E%3Cpath d='M16 3c5 8 9 12 9 17"
    "a9 9 0 0 1-18 0c0-5 4-9 9-17z' fill='%232b83c4'/%3E%3C/svg%3E"
)
"""A drop, for the browser's tab."""
