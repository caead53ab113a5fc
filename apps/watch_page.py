"""The live page of a capture, as one text: it loads nothing from elsewhere and asks `/state.json` twice a second.

Made to be read from three metres by someone who holds a board: one figure, one colour, one picture, a few big words.
"""

from __future__ import annotations

from rainstereo.apps.stylesheet import ICON

PAGE = (
    """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,initial-scale=1">
<title>Calibrating</title><link rel="icon" href="@ICON@">
<style>
:root{--back:#0a0e13;--ink:#fff;--dim:#b9c4d0;--wait:#ffc23d;--good:#39e58c;--bad:#ff6b6b;--line:#2b3642}
*{box-sizing:border-box;margin:0}
html,body{height:100%}
body{background:var(--back);color:var(--ink);overflow:hidden;padding:1.6vmin;gap:1.4vmin;display:grid;
  font:16px/1.2 system-ui,-apple-system,"Segoe UI",Roboto,Helvetica,Arial,"DejaVu Sans",sans-serif;
  grid-template:minmax(0,1fr) auto/minmax(0,1.62fr) minmax(0,1fr)}
#view{min-height:0;min-width:0;display:flex;align-items:center;justify-content:center;position:relative}
#view svg{width:100%;height:100%;max-height:100%;display:block}
#side{display:flex;flex-direction:column;min-height:0;gap:1.4vmin;justify-content:space-between}
#figure{font-weight:800;font-size:min(12.5vw,27vh);line-height:.86;letter-spacing:-.045em;
  font-variant-numeric:tabular-nums;
  white-space:nowrap;color:var(--wait)}
#figure small{font-size:.26em;font-weight:600;letter-spacing:0;margin-left:.12em;color:var(--ink)}
#target{font-size:min(2.5vw,4.4vh);font-weight:600;color:var(--dim);margin-top:.5vmin}
#bar{height:1.6vmin;background:var(--line);border-radius:1vmin;margin-top:1vmin;overflow:hidden}
#bar i{display:block;height:100%;width:0;background:var(--wait)}
#do{display:flex;flex-direction:column;gap:.7vmin;font-weight:700;font-size:min(3vw,5.2vh);line-height:1.1}
#do .where{font-size:min(4.4vw,7.8vh);font-weight:800;line-height:1;text-transform:uppercase;color:#fff}
#do .more{color:var(--ink)}
#do .lean{color:#8fd3ff}
#last{grid-column:1/-1;display:flex;gap:2vmin;align-items:center;justify-content:space-between;font-size:min(2.3vw,4vh);
  font-weight:600;min-height:1.5em;border-top:.3vmin solid var(--line);padding-top:1vmin}
#fate{min-width:0;overflow:hidden;text-overflow:ellipsis;display:-webkit-box;-webkit-line-clamp:2;
  -webkit-box-orient:vertical}
#fate b{font-weight:800;padding:.05em .4em;border-radius:.25em;color:#0a0e13;background:var(--dim);margin-right:.4em}
#fate.used b{background:var(--good)}#fate.redundant b{background:#8fd3ff}#fate.rejected b{background:var(--bad)}
#counts{white-space:nowrap;color:var(--dim);flex:none}
#counts b{color:var(--ink)}
button{font:inherit;font-size:1rem;color:var(--dim);background:none;border:1px solid var(--line);border-radius:.4em;
  padding:.2em .6em;cursor:pointer}
button[aria-pressed=true]{color:var(--ink);border-color:var(--ink)}
#mirror{position:absolute;right:.4rem;top:.4rem;background:#0a0e13cc}
body.met{background:#04552b}body.met #figure,body.done #figure{color:var(--good)}body.met #bar i{background:var(--good)}
body.waiting #figure,body.learning #figure{color:var(--line)}
body.met #do .where,body.met #do .more{color:#fff}
body.failed,body.lost{background:#4a0f14}body.failed #figure,body.lost #figure{color:#ffd0d0}
.cell{stroke:#0a0e13;stroke-width:2}
.flipped{transform:scaleX(-1);transform-origin:center}
#notes{font-size:min(1.7vw,2.8vh);color:var(--wait);line-height:1.25;overflow:hidden;max-height:4.9em;overflow-wrap:anywhere}
@media(max-aspect-ratio:1/1){
  body{grid-template:auto minmax(0,1fr) auto/minmax(0,1fr)}
  #side{order:-1}#figure{font-size:min(34vw,19vh)}#target{font-size:min(5vw,3vh)}
  #do{font-size:min(6vw,3.1vh)}#do .where{font-size:min(9.4vw,5vh)}
  #last{font-size:min(4.6vw,2.4vh);flex-wrap:wrap}#notes{font-size:min(3.6vw,2vh)}
  #view svg{height:auto;max-height:100%}
}
</style></head>
<body class="waiting">
<div id="view">
<svg id="image" role="img" aria-label="The dry image: certainty by cell, and where to hold the board"></svg>
<button id="mirror" aria-pressed="false">mirror</button></div>
<div id="side"><div><div id="figure">&ndash;</div><div id="target"></div><div id="bar"><i></i></div></div>
<div id="do"><div class="where">Starting</div><div class="more"></div><div class="lean"></div></div>
<div id="notes"></div></div>
<div id="last"><div id="fate"></div><div id="counts"></div></div>
<script>
"use strict";
const $=id=>document.getElementById(id), SVG="http://www.w3.org/2000/svg";
let state=null, missed=0, drawn="", mirrored=location.hash==="#mirror";
function el(name,attributes,parent){const e=document.createElementNS(SVG,name);
  for(const k in attributes)e.setAttribute(k,attributes[k]);if(parent)parent.appendChild(e);return e}
function say(node,text){if(node.textContent!==text)node.textContent=text}
function px(v){return v===null||v===undefined?"–":v>=10?v.toFixed(0):v>=1?v.toFixed(1):v.toFixed(2)}
function sides(text){return mirrored?text.replace(/left|right/g,w=>w==="left"?"right":"left"):text}
function together(text){return text.replace(/([0-9]) (?=cm|m|px|degrees)/g,"$1\u00a0")}
function colour(s,target){if(s===null||s===undefined)return"#1b232c";const r=s/target;
  return r<=1?"#1fa463":r<=2?"#8f9c22":r<=4?"#b3701b":"#7d3030"}
function smooth(points){return points.map(p=>p.join(",")).join(" ")}
function draw(s){
  const svg=$("image"), size=(s.sizes||{}).dry||[1280,960], w=size[0], h=size[1];
  const key=JSON.stringify([size,s.coverage,s.sigma,s.proposal,s.picture,s.target,s.phase]);
  if(key===drawn)return;drawn=key;
  svg.replaceChildren();svg.setAttribute("viewBox",`-6 -6 ${w+12} ${h+12}`);
  const cover=(s.coverage||{}).dry||[], sigma=s.sigma||[], rows=9, columns=12, cw=w/columns, ch=h/rows;
  el("rect",{x:0,y:0,width:w,height:h,fill:"#1b232c"},svg);
  if(s.picture)el("image",{href:"/picture.jpg?"+s.picture,x:0,y:0,width:w,height:h,preserveAspectRatio:"none"},svg);
  const opacity=s.picture?.62:1;
  for(let r=0;r<rows;r++)for(let c=0;c<columns;c++){
    const value=sigma[r]?sigma[r][c]:null, count=cover[r]?cover[r][c]:0;
    el("rect",{class:"cell",x:c*cw,y:r*ch,width:cw,height:ch,fill:colour(value,s.target),"fill-opacity":opacity},svg);
    if(count)el("circle",{cx:(c+.5)*cw,cy:(r+.5)*ch,r:Math.min(cw,ch)*Math.min(.07+.045*Math.sqrt(count),.34),fill:"#fff",
      "fill-opacity":.55},svg);
  }
  const p=s.proposal, wanted=s.phase==="learning"||s.phase==="capturing"||s.phase==="waiting";
  if(p&&wanted){
    const edge=p.outline.dry;
    el("polygon",{points:smooth(edge),fill:"#fff","fill-opacity":.16,stroke:"#000","stroke-width":w/70,
      "stroke-linejoin":"round"},svg);
    for(const line of p.mesh.dry)
      el("polyline",{points:smooth(line),fill:"none",stroke:"#fff","stroke-width":w/420},svg);
    el("polygon",{id:"outline",points:smooth(edge),fill:"none",stroke:"#fff","stroke-width":w/110,
      "stroke-linejoin":"round"},svg);
  }
  el("rect",{x:0,y:0,width:w,height:h,fill:"none",stroke:"#fff","stroke-width":w/320},svg);
  svg.classList.toggle("flipped",mirrored);
}
function words(s){
  const p=s.proposal, [where,more,lean]=document.querySelectorAll("#do div");
  let a="",b="",c="";
  if(s.phase==="met"){a="Enough";b="The target is met."}
  else if(s.phase==="finishing"){a="Solving";b="Put the board down."}
  else if(s.phase==="done"){a="Done";b=s.trouble||"The rig is written."}
  else if(s.phase==="failed"){a="No rig";b=s.trouble}
  else if(p){a=sides(p.where);b=p.how_far;c=sides(p.lean)}
  else if(!s.used&&!s.pending){a="Waiting";b="for the first pair of images"}
  else{a="Go on";b=s.trouble||"hold the board elsewhere"}
  say(where,a);say(more,together(b));say(lean,together(c));
}
function show(s){
  state=s;
  document.body.className=s.phase;
  const figure=$("figure");
  figure.replaceChildren(document.createTextNode(px(s.figure)));
  if(s.figure!==null){const unit=document.createElement("small");unit.textContent="px";figure.appendChild(unit)}
  say($("target"),`target ${px(s.target)} px`+(s.figure===null?"":` · worst: ${sides(s.worst_at)}`));
  const share=s.figure===null?0:s.figure<=s.target?1:Math.max(.02,1-Math.log(s.figure/s.target)/Math.log(60));
  $("bar").firstElementChild.style.width=(100*share).toFixed(1)+"%";
  words(s);draw(s);
  const fate=$("fate");fate.className=s.last?s.last.fate:"";fate.replaceChildren();
  if(s.last){const b=document.createElement("b");b.textContent=s.last.fate;
    fate.append(b,s.last.name+(s.last.reason?": "+s.last.reason:""))}
  const counts=$("counts");counts.replaceChildren();
  for(const [n,what] of [[s.used,"used"],[s.redundant,"redundant"],[s.rejected,"rejected"],[s.pending,"to come"]])
    if(n||what==="used"){const b=document.createElement("b");b.textContent=n;
      counts.append(counts.childNodes.length?"  ·  ":"",b," "+what)}
  say($("notes"),[s.phase==="learning"?s.trouble:""].concat(s.notes||[]).filter(Boolean).slice(-3).join("  ·  "));
  document.title=(s.phase==="met"||s.phase==="done"?"✓ ":"")+px(s.figure)+" px";
}
function lost(){
  if(state&&(state.phase==="done"||state.phase==="failed"))return;
  document.body.className="lost";
  const [where,more,lean]=document.querySelectorAll("#do div");
  say(where,"No answer");say(more,"The program has ended, or this page cannot reach it.");say(lean,"");
}
async function poll(){
  try{
    const answer=await fetch("/state.json",{cache:"no-store"});
    if(!answer.ok)throw new Error(answer.status);
    show(await answer.json());missed=0;
  }catch(error){if(++missed>=4)lost()}
  setTimeout(poll,500);
}
$("mirror").onclick=()=>{mirrored=!mirrored;history.replaceState(null,"",mirrored?"#mirror":"#");drawn="";
  $("mirror").setAttribute("aria-pressed",mirrored);if(state)show(state)};
$("mirror").setAttribute("aria-pressed",mirrored);
poll();
</script></body></html>
"""
).replace("@ICON@", ICON)
