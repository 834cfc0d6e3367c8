"""Sub-pixel observations: the patch around each point, aligned to every frame that shows it."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numba
import numpy as np

from factors import tangent_basis
from factors._image_kernels import ALIGNED, FAR, FLAT, MASKED, UNSTEADY, align_patches, make_templates
from factors.sphere_image import SphereImage
from gsba import read
from gsba.geometry import erp_from_bearings
from gsba.log import track
from gsba.rig import CubeRig, owner_faces
from gsba.types import Counts, FrameSet, Keypoints, Landmarks, Tracks

@dataclass
class S:
    patch:int=11
    max_views:int=12
    near:int=24
    max_angle:float=40.
    max_ratio:float=1.8
    sigma_affine:float=0.15
    sigma_grey:float=3.0
    least_contrast:float=2.0
    max_shift:float=1.5
    min_zncc:float=0.85
    steps:int=12
    tol:float=0.02
    window:float=0.6  # of half
    spacing:float=1.0
    mix:bool=False
    max_sigma:float=0.5

class Views: pass

def plan(landmarks, poses, kp, s):
    t=landmarks.tracks; X=landmarks.points_world
    starts=np.searchsorted(t.points,np.arange(t.num_points+1))
    C=poses[:,:3,3].copy()
    ref=np.empty(t.num_points,np.int64)
    _references(starts,t.frames.astype(np.int64),C,X,ref)
    D=np.linalg.norm(C[:,None]-C[None],axis=2)
    near=np.argsort(D,axis=1,kind='stable')[:,1:s.near+1]
    # include observed frames always
    pts,fr=_views(starts,t.frames.astype(np.int64),C,X,ref,near,np.cos(np.deg2rad(s.max_angle)),s.max_ratio,s.max_views)
    return t.frames[ref].astype(np.int64), ref, pts, fr

@numba.njit(cache=True,nogil=True)
def _references(starts,frames,C,X,ref):
    for j in range(len(X)):
        best=np.inf
        for a in range(starts[j],starts[j+1]):
            cost=0.
            va=X[j]-C[frames[a]]; da=np.sqrt((va**2).sum())
            for b in range(starts[j],starts[j+1]):
                vb=X[j]-C[frames[b]]; db=np.sqrt((vb**2).sum())
                c=(va*vb).sum()/(da*db)
                cost+=2*(1-c)+0.25*np.log(da/db)**2
            if cost<best:
                best=cost; ref[j]=a

@numba.njit(cache=True,nogil=True)
def _views(starts,frames,C,X,ref,near,min_cos,max_ratio,max_views):
    J=len(X)
    pts=np.empty(J*(max_views+1)+len(frames),np.int64); fr=np.empty_like(pts); n=0
    costs=np.empty(near.shape[1]); 
    seen=np.full(len(C),-1)
    for j in range(J):
        r=frames[ref[j]]
        vr=X[j]-C[r]; dr=np.sqrt((vr**2).sum())
        seen[r]=j; m=0
        for a in range(starts[j],starts[j+1]):
            f=frames[a]
            if seen[f]!=j:
                seen[f]=j; pts[n]=j; fr[n]=f; n+=1; m+=1
        for k in range(near.shape[1]):
            f=near[r,k]
            costs[k]=np.inf
            if seen[f]==j: continue
            v=X[j]-C[f]; d=np.sqrt((v**2).sum())
            c=(v*vr).sum()/(d*dr); q=d/dr
            if c<min_cos or q>max_ratio or q*max_ratio<1: continue
            costs[k]=2*(1-c)+0.25*np.log(q)**2
        order=np.argsort(costs)
        for k in order:
            if m>=max_views or costs[k]==np.inf: break
            pts[n]=j; fr[n]=near[r,k]; n+=1; m+=1
    return pts[:n],fr[:n]

def window(s):
    n=s.patch; r=n//2
    g=np.exp(-0.5*(np.arange(-r,r+1)/(s.window*(r+.5)))**2)
    w=np.outer(g,g).ravel()
    return (w/w.max())

def align(frames, poses, landmarks, kp, s, num_threads=2):
    ref_frame, ref_obs, pts, fr = plan(landmarks,poses,kp,s)
    X=landmarks.points_world
    h=s.spacing*2*np.pi/frames.width
    Y=np.einsum('jba,jb->ja',poses[ref_frame,:3,:3],X-poses[ref_frame,:3,3])
    d=np.linalg.norm(Y,axis=1); b=Y/d[:,None]
    B=h*np.swapaxes(tangent_basis(b),1,2)  # J,3,2
    worldB=np.einsum('jab,jbc->jac',poses[ref_frame,:3,:3],B)
    O_=np.einsum('oba,ob->oa',poses[fr,:3,:3],X[pts]-poses[fr,:3,3])/d[pts,None]
    S_=np.einsum('oba,obc->oac',poses[fr,:3,:3],worldB[pts])
    n2=s.patch**2; J=len(X)
    grey,bx,by=(np.zeros((J,n2),np.float32) for _ in range(3))
    inv=np.zeros((J,8,8),np.float32); tst=np.full(J,FLAT,np.uint8)
    w=window(s); prior=(s.sigma_grey/s.sigma_affine)**2
    nomask=np.zeros((0,0),np.bool_)
    warps=np.zeros((len(pts),6)); zn=np.zeros(len(pts)); var=np.zeros(len(pts)); st=np.full(len(pts),UNSTEADY,np.uint8)
    order=np.argsort(ref_frame,kind='stable'); cuts=np.searchsorted(ref_frame[order],np.arange(len(frames)+1))
    def load(f):
        m=read.load_mask(frames,f)
        im=cv2.cvtColor(read.load_erp(frames,f),cv2.COLOR_RGB2GRAY)
        return SphereImage.of(im).coefficients, nomask if m is None else m
    def p1(f):
        c,m=load(f)
        make_templates(c,m,order[cuts[f]:cuts[f+1]],b,B,w,prior,s.least_contrast,grey,bx,by,inv,tst)
    use=np.flatnonzero
    with ThreadPoolExecutor(num_threads) as pool: list(pool.map(p1,range(len(frames))))
    good=np.flatnonzero(tst[pts]==ALIGNED)
    order2=good[np.argsort(fr[good],kind='stable')]; cuts2=np.searchsorted(fr[order2],np.arange(len(frames)+1))
    def p2(f):
        c,m=load(f)
        align_patches(c,m,order2[cuts2[f]:cuts2[f+1]],pts,O_,S_,w,prior,3*s.max_shift,s.steps,s.tol,grey,bx,by,inv,warps,zn,var,st)
    with ThreadPoolExecutor(num_threads) as pool: list(pool.map(p2,range(len(frames))))
    # post
    out=Views()
    out.__dict__.update(locals())
    return out

def collect(v,s):
    """Aligned obs -> keypoints, tracks."""
    frames,poses,kp,landmarks=v.frames,v.poses,v.kp,v.landmarks
    pred=v.O_/np.linalg.norm(v.O_,axis=1)[:,None]
    ray=v.O_+np.einsum('oij,oj->oi',v.S_,v.warps[:,:2])
    ln=np.linalg.norm(ray,axis=1); bear=ray/ln[:,None]
    shift_px=np.linalg.norm(np.cross(pred,bear),axis=1)/(2*np.pi/frames.width)
    spread=np.empty_like(v.S_)
    wq=v.warps
    M=np.stack([np.stack([1+wq[:,2],wq[:,4]],-1),np.stack([wq[:,3],1+wq[:,5]],-1)],-2)
    Jt=np.einsum('oij,ojk,okl->oil',tangent_basis(bear),v.S_,M)/ln[:,None,None]
    Cq=v.inv[v.pts][:,:2,:2].astype(float)*v.var[:,None,None]
    C=np.einsum('oij,ojk,olk->oil',Jt,Cq,Jt)
    px=2*np.pi/frames.width
    major=np.sqrt(np.maximum(np.linalg.eigvalsh(C)[:,1],0))/px
    ok=(v.st==ALIGNED)&(v.zn>s.min_zncc)&(shift_px<s.max_shift)&(major<s.max_sigma)
    # reference
    J=len(v.b)
    num=np.bincount(v.pts[ok],minlength=J)
    # mean variance per template
    vmean=np.bincount(v.pts[ok],v.var[ok],J)/np.maximum(num,1)
    Jr=np.einsum('jik,jkl->jil',tangent_basis(v.b),v.B)
    Cr=np.einsum('oij,ojk,olk->oil',Jr,v.inv[:,:2,:2].astype(float)*vmean[:,None,None],Jr)
    keep=num>0
    P=np.concatenate([np.flatnonzero(keep),v.pts[ok]]); F=np.concatenate([v.ref_frame[keep],v.fr[ok]])
    BE=np.concatenate([v.b[keep],bear[ok]]); CC=np.concatenate([Cr[keep],C[ok]])
    return P,F,BE,CC,dict(total=len(v.pts),st=np.bincount(v.st,minlength=5).tolist(),tst=np.bincount(v.tst,minlength=5).tolist(),ok=int(ok.sum()),templates=int(keep.sum()),zn=int(((v.st==ALIGNED)&(v.zn<=s.min_zncc)).sum()),shift=int(((v.st==ALIGNED)&(v.zn>s.min_zncc)&(shift_px>=s.max_shift)).sum())), ok

def pack(P,F,BE,CC,num_frames,rig,colors):
    order=np.lexsort((P,F)); 
    P,F,BE,CC=P[order],F[order],BE[order],CC[order]
    starts=np.searchsorted(F,np.arange(num_frames+1))
    faces=owner_faces(BE)
    info=np.linalg.inv(CC)
    L=np.linalg.cholesky(info); roots=np.swapaxes(L,1,2)
    sig=np.linalg.det(CC)**0.25
    kp=Keypoints(starts,rig.project(BE,faces),faces,BE,sig,colors[P],np.ascontiguousarray(roots))
    o=np.lexsort((F,P)); _,pt=np.unique(P[o],return_inverse=True)
    tr=Tracks(pt.astype(np.int32),F[o].astype(np.int32),(o-starts[F[o]]).astype(np.int32),int(pt.max())+1)
    return kp,tr
